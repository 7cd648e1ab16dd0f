"""Unknown materials are found wherever they stand, everything else stays as it is."""

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scene_texts import BALL, DIFFUSE, PRINCIPLED, ROUGHPLASTIC, WRAPPERS, render

from unbake.errors import UserError
from unbake.fields.shapes import bsdf_classes, met_shapes
from unbake.fields.texture import material_textures
from unbake.imaging.pictures import write_exr
from unbake.scene import edit
from unbake.transport.optimized import has_optimized_material


def plugins(parsed):
    return [node.props.plugin_name() for node in parsed.state.nodes]


# ------------------------------------------------------------------------------- to_principled


@pytest.mark.parametrize("wrapper", WRAPPERS)
@pytest.mark.parametrize(
    ("bsdf", "roughness"), [(DIFFUSE, 0.9), (ROUGHPLASTIC, 0.2)], ids=["diffuse", "roughplastic"]
)
def test_diffuse_and_rough_plastic_become_principled(wrapper, bsdf, roughness, parse):
    parsed = parse(BALL.format(WRAPPERS[wrapper].format(bsdf)))
    assert not parsed.principled_nodes()
    assert edit.to_principled(parsed) == 1
    (node,) = parsed.principled_nodes()
    index = {"eta"} if bsdf == ROUGHPLASTIC else set()
    assert set(node.props.keys()) == {"base_color", "roughness"} | index
    assert np.allclose(node.props["base_color"], [0.6, 0.3, 0.1])
    assert node.props["roughness"] == pytest.approx(roughness)
    assert not {"diffuse", "roughplastic"} & set(plugins(parsed))
    # A second time there is nothing left to do
    assert edit.to_principled(parsed) == 0
    assert np.isfinite(render(parsed.instantiate(), 2)).all()


def test_the_defaults_of_mitsuba_are_kept(parse):
    parsed = parse(
        BALL.format('<bsdf type="diffuse"/>') + BALL.format('<bsdf type="roughplastic"/>')
    )
    assert edit.to_principled(parsed) == 2
    found = [(n.props["base_color"], n.props["roughness"]) for n in parsed.principled_nodes()]
    assert found == [(0.5, 0.9), (0.5, pytest.approx(math.sqrt(0.1)))]
    indices = [n.props.get("eta", None) for n in parsed.principled_nodes()]
    assert indices == [None, pytest.approx(1.49 / 1.000277)]


def plastic(*properties):
    """Rough plastic with properties: type, name and value of each."""
    inside = "".join(f'<{t} name="{name}" value="{value}"/>' for t, name, value in properties)
    return f'<bsdf type="roughplastic">{inside}</bsdf>'


@pytest.mark.parametrize(
    ("indices", "eta"),
    [
        ([("float", "int_ior", 1.7), ("float", "ext_ior", 1.0)], 1.7),
        ([("integer", "int_ior", 2)], 2 / 1.000277),
        ([("string", "int_ior", "diamond"), ("string", "ext_ior", "vacuum")], 2.419),
        ([("float", "int_ior", 1.5), ("string", "ext_ior", "water")], 1.5 / 1.333),
        ([("float", "int_ior", 1.0)], 1.0),
        # That of `principled` where it does not say: nothing changes
        ([("float", "int_ior", 1.5), ("float", "ext_ior", 1.0)], None),
        ([("float", "int_ior", 1.5)], None),
    ],
)
def test_rough_plastic_keeps_its_index_of_refraction(indices, eta, parse):
    """All of it was 1.5, in photographs and in fits."""
    parsed = parse(BALL.format(plastic(*indices)))
    edit.to_principled(parsed)
    (node,) = parsed.principled_nodes()
    assert node.props.get("eta", None) == (None if eta is None else pytest.approx(eta, rel=1e-3))
    assert np.isfinite(render(parsed.instantiate(), 2)).all()


@pytest.mark.parametrize(
    ("indices", "told"),
    [
        ([("float", "int_ior", 1.0), ("float", "ext_ior", 1.5)], "'int_ior' 1.0 and 'ext_ior' 1.5"),
        ([("string", "int_ior", "jam")], "'int_ior' 'jam' and 'ext_ior' 'air'"),
        ([("float", "ext_ior", 0)], "'int_ior' 'polypropylene' and 'ext_ior' 0.0"),
        ([("boolean", "int_ior", "true")], "'int_ior' True and 'ext_ior' 'air'"),
    ],
)
def test_rough_plastic_has_an_index_of_refraction(indices, told, parse):
    parsed = parse(BALL.format(plastic(*indices)))
    with pytest.raises(UserError, match="roughplastic has no index of refraction") as caught:
        edit.to_principled(parsed)
    assert f"from 1 by {told}. Give numbers above 0" in str(caught.value)
    assert "scene.xml (line " in str(caught.value)


def test_what_principled_cannot_keep_is_told(parse):
    white = '<bsdf type="roughplastic"><spectrum name="specular_reflectance" value="1"/></bsdf>'
    kept = [
        plastic(("string", "distribution", "ggx"), ("boolean", "nonlinear", "false")),
        plastic(("float", "specular_reflectance", 1)),
        plastic(("rgb", "specular_reflectance", "1 1 1")),
        plastic(("string", "int_ior", "diamond"), ("boolean", "sample_visible", "false")),
        white,
        ROUGHPLASTIC,
        DIFFUSE,
    ]
    assert edit.lost_properties(parse("".join(map(BALL.format, kept)))) is None
    texture = '<texture type="checkerboard" name="specular_reflectance"/>'
    lost = [
        plastic(("boolean", "nonlinear", "true"), ("string", "distribution", "beckmann")),
        plastic(("rgb", "specular_reflectance", "1 1 0.5"), ("boolean", "nonlinear", "true")),
        f'<bsdf type="roughplastic">{texture}</bsdf>',
    ]
    told = edit.lost_properties(parse("".join(map(BALL.format, kept + lost))))
    assert told == (
        "'specular_reflectance' of 2 BSDFs, 'nonlinear' of 2 BSDFs, "
        "'distribution' beckmann of 1 BSDF"
    )


def test_shapes_without_a_bsdf_share_a_new_one(parse):
    """Mitsuba takes them for diffuse grey: they are unknown like any other. Lamps are not."""
    lamp = '<emitter type="area"/>'
    group = f'<shape type="shapegroup" id="group">{BALL.format("")}</shape>'
    instance = '<shape type="instance"><ref id="group"/></shape>'
    shapes = [BALL.format(x) for x in ("", "", lamp, '<bsdf type="dielectric"/>', DIFFUSE)]
    parsed = parse("".join([*shapes, group, instance]))
    assert edit.to_principled(parsed) == 2 and edit.to_principled(parsed) == 0
    assert edit.material_names(parsed)[-1] == "without-bsdf"
    scene = parsed.instantiate(merge=False)
    optimized = [has_optimized_material(shape) for shape in met_shapes(scene)]
    assert sorted(optimized) == [False, False, True, True, True, True]


def test_other_materials_stay(parse):
    others = ["dielectric", "conductor", "roughconductor", "plastic", "principled"]
    parsed = parse("".join(BALL.format(f'<bsdf type="{name}"/>') for name in others))
    assert edit.to_principled(parsed) == 0
    assert [name for name in plugins(parsed) if name in others] == others


def test_one_material_of_two_shapes_is_changed_once(parse):
    shared = DIFFUSE.replace("<bsdf", '<bsdf id="shared"', 1)
    parsed = parse(shared + 2 * BALL.format('<ref id="shared"/>'))
    assert edit.to_principled(parsed) == 1
    assert len(parsed.instantiate().shapes()) in (1, 2)


def test_a_converted_diffuse_scene_looks_much_the_same(parse):
    before = render(parse(BALL.format(DIFFUSE)).instantiate(), 256)
    parsed = parse(BALL.format(DIFFUSE))
    edit.to_principled(parsed)
    after = render(parsed.instantiate(), 256)
    assert 0.02 < np.abs(after - before).mean() + 0.02 < 0.08


def test_materials_of_lamps_alone_are_told_by_number(parse):
    """Not those that another shape has as well, also inside of another BSDF."""
    names = ("lamp", "wall", "both", "inside")
    shared = "".join(f'<bsdf type="principled" id="{name}"/>' for name in names)
    lamp = BALL.replace("</shape>", '<emitter type="area"/></shape>')
    shapes = lamp.format('<bsdf type="twosided"><ref id="lamp"/></bsdf>')
    shapes += BALL.format('<ref id="wall"/>') + BALL.format('<ref id="both"/>')
    shapes += lamp.format('<ref id="both"/>') + lamp.format('<ref id="inside"/>')
    shapes += BALL.format('<bsdf type="mask"><ref id="inside"/></bsdf>')
    parsed = parse(shared + shapes)
    known = edit.lamp_materials(parsed)
    assert [edit.material_names(parsed)[number] for number in known] == ["lamp"]
    furnace = parse(lamp.format('<bsdf type="principled"/>'))
    assert edit.lamp_materials(furnace) == frozenset()


# -------------------------------------------------------------------------------- set_textures


class Painted:
    """Materials of one colour, for textures that are asked from inside stock integrators."""

    carried = False

    def __init__(self, albedo, roughness):
        self.albedo, self.roughness = albedo, roughness

    def __iter__(self):
        return iter(("albedo", "roughness"))

    def evaluate(self, si, valid, engine="coopvec"):
        lanes = dr.zeros(mi.Float, dr.width(si.p))
        return {"albedo": mi.Color3f(self.albedo) + lanes, "roughness": self.roughness + lanes}


def painted(parsed, albedo, roughness):
    edit.set_textures(parsed, material_textures(Painted(albedo, roughness)))
    return parsed.instantiate()


@pytest.mark.parametrize("wrapper", WRAPPERS)
def test_fields_are_used_inside_every_wrapper(wrapper, parse):
    content = BALL.format(WRAPPERS[wrapper].format(PRINCIPLED))
    expected = render(parse(content).instantiate())
    same = render(painted(parse(content), [0.6, 0.3, 0.1], 0.2))
    assert np.allclose(same, expected, rtol=1e-3, atol=1e-3)
    other_albedo = render(painted(parse(content), [0.1, 0.3, 0.1], 0.2))
    assert np.abs(other_albedo[..., 0] - expected[..., 0]).max() > 0.1
    other_roughness = render(painted(parse(content), [0.6, 0.3, 0.1], 0.9))
    assert np.abs(other_roughness - expected).max() > 1e-3


def test_all_other_parameters_stay(parse):
    keys = {"metallic": 0.3, "specular": 0.8, "clearcoat": 0.4, "clearcoat_gloss": 0.6,
            "sheen": 0.2, "sheen_tint": 0.7, "spec_tint": 0.1, "flatness": 0.5,
            "anisotropic": 0.25}  # fmt: skip
    extra = "".join(f'<float name="{key}" value="{value}"/>' for key, value in keys.items())
    content = BALL.format(PRINCIPLED.replace("</bsdf>", extra + "</bsdf>"))
    parsed = parse(content)
    edit.set_textures(parsed, material_textures(Painted([0.6, 0.3, 0.1], 0.2)))
    (node,) = parsed.principled_nodes()
    assert {key: pytest.approx(node.props[key]) for key in keys} == keys
    assert np.allclose(
        render(parsed.instantiate()), render(parse(content).instantiate()), rtol=1e-3, atol=1e-3
    )


def test_bitmaps_give_way_to_fields(parse, tmp_path):
    write_exr(tmp_path / "paint.exr", np.random.default_rng(0).random((8, 8, 3)))
    bitmap = '<texture type="bitmap" name="base_color"><string name="filename" value="paint.exr"/>'
    content = BALL.format(f'<bsdf type="principled">{bitmap}</texture></bsdf>')
    assert np.allclose(
        render(painted(parse(content), [0.6, 0.3, 0.1], 0.2)),
        render(parse(BALL.format(PRINCIPLED)).instantiate()),
        rtol=1e-3,
        atol=1e-3,
    )


def test_nothing_to_fit_is_an_error(parse):
    parsed = parse(BALL.format('<bsdf type="dielectric"/>'))
    with pytest.raises(UserError, match=r"scene.xml: no material to fit"):
        edit.set_textures(parsed, {})


def test_roughness_is_shown_in_place_of_albedo(parse):
    content = '<bsdf type="principled"><float name="roughness" value="0.3"/></bsdf>'
    parsed = parse(BALL.format(content) + BALL.format('<bsdf type="principled"/>'))
    edit.show_as_albedo(parsed, "roughness", 0.5)
    assert [n.props["base_color"] for n in parsed.principled_nodes()] == [pytest.approx(0.3), 0.5]


def blended(first, second):
    return f'<bsdf type="blendbsdf"><float name="weight" value="0.2"/>{first}{second}</bsdf>'


def test_the_part_to_fit_fills_blends_with_a_part_that_is_known(parse):
    metal, matte = '<bsdf type="roughconductor"/>', '<bsdf type="principled"/>'
    bumpy = WRAPPERS["bumpmap"].format(matte)
    shapes = [
        blended(metal, matte),
        blended(bumpy, metal),
        WRAPPERS["twosided"].format(blended(metal, blended(matte, matte))),
        blended(matte, matte),
        blended(metal, metal),
    ]
    parsed = parse("".join(BALL.format(shape) for shape in shapes))
    assert edit.fill_blends(parsed) == 3 and edit.fill_blends(parsed) == 0
    scene = parsed.instantiate(merge=False)
    metals = ["RoughConductor" in bsdf_classes(shape) for shape in scene.shapes()]
    assert sorted(metals) == [False] * 4 + [True]
    bumps = ["BumpMap" in bsdf_classes(shape) for shape in scene.shapes()]
    assert sorted(bumps) == [False] * 4 + [True]
