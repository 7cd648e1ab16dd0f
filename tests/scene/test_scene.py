"""Scenes: unknown materials are found wherever they stand, everything else stays as it is."""

import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from unbake.errors import UserError
from unbake.fields.emission import Emission, emission_textures
from unbake.fields.texture import material_textures
from unbake.imaging.pictures import write_exr
from unbake.scene import edit, emitters
from unbake.scene import parse as scenes

DIFFUSE = '<bsdf type="diffuse"><rgb name="reflectance" value="0.6 0.3 0.1"/></bsdf>'
ROUGHPLASTIC = (
    '<bsdf type="roughplastic"><rgb name="diffuse_reflectance" value="0.6 0.3 0.1"/>'
    '<float name="alpha" value="0.04"/><float name="int_ior" value="1.7"/></bsdf>'
)
PRINCIPLED = (
    '<bsdf type="principled"><rgb name="base_color" value="0.6 0.3 0.1"/>'
    '<float name="roughness" value="0.2"/></bsdf>'
)
WRAPPERS = {
    "alone": "{}",
    "twosided": '<bsdf type="twosided">{}</bsdf>',
    "mask": '<bsdf type="mask"><float name="opacity" value="0.7"/>{}</bsdf>',
    "bumpmap": '<bsdf type="bumpmap"><texture type="bitmap" name="bump">'
    '<string name="filename" value="bump.exr"/></texture>{}</bsdf>',
    "normalmap": '<bsdf type="normalmap"><rgb name="normalmap" value="0.5 0.5 1"/>{}</bsdf>',
    "all": '<bsdf type="mask"><float name="opacity" value="0.7"/><bsdf type="twosided">'
    '<bsdf type="bumpmap"><texture type="bitmap"><string name="filename" value="bump.exr"/>'
    "</texture>{}</bsdf></bsdf></bsdf>",
}
ROOM = """<scene version="3.0.0">
  <sensor type="perspective"><float name="fov" value="40"/>
    <transform name="to_world">
      <lookat origin="0,0,4" target="0,0,0" up="0,1,0"/>
    </transform>
    <film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="12"/>
      <rfilter type="box"/></film>
  </sensor>
  <emitter type="constant"><rgb name="radiance" value="1 1 1"/></emitter>
  {}
</scene>
"""
BALL = '<shape type="sphere">{}</shape>'


@pytest.fixture
def parse(tmp_path):
    """A parsed scene of these shapes."""

    def run(content):
        write_exr(tmp_path / "bump.exr", np.random.default_rng(5).random((8, 8)) / 20)
        path = tmp_path / "scene.xml"
        path.write_text(ROOM.format(content))
        return scenes.parse(path)

    return run


def render(scene, spp=64, seed=0):
    integrator = mi.load_dict({"type": "path", "max_depth": 4})
    return np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed))[..., :3]


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
    assert set(node.props.keys()) == {"base_color", "roughness"}
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
    edit.show_roughness_as_albedo(parsed)
    assert [n.props["base_color"] for n in parsed.principled_nodes()] == [pytest.approx(0.3), 0.5]


# --------------------------------------------------------------------------------------- files


@pytest.fixture
def with_files(tmp_path):
    """A scene with a mesh and two bitmaps in folders of their own; `absolute` paths or not."""

    def make(absolute):
        root = tmp_path / "original"
        (root / "meshes").mkdir(parents=True)
        rng = np.random.default_rng(1)
        write_exr(root / "textures" / "paint.exr", rng.random((8, 8, 3)))
        write_exr(root / "light" / "paint.exr", rng.random((8, 16, 3)))
        mesh = mi.load_dict({"type": "cube"})
        mesh.write_ply(str(root / "meshes" / "box.ply"))
        start = f"{root}/" if absolute else ""
        text = ROOM.replace(
            '<emitter type="constant"><rgb name="radiance" value="1 1 1"/></emitter>',
            '<emitter type="envmap">'
            f'<string name="filename" value="{start}light/paint.exr"/></emitter>',
        ).format(
            f'<shape type="ply"><string name="filename" value="{start}meshes/box.ply"/>'
            '<bsdf type="twosided"><bsdf type="principled">'
            '<texture type="bitmap" name="base_color">'
            f'<string name="filename" value="{start}textures/paint.exr"/></texture>'
            "</bsdf></bsdf></shape>"
        )
        (root / "scene.xml").write_text(text)
        return root / "scene.xml"

    return make


@pytest.mark.parametrize("absolute", [False, True], ids=["relative", "absolute"])
def test_a_copy_has_all_files_and_looks_the_same(absolute, with_files, tmp_path, monkeypatch):
    source = with_files(absolute)
    # Names are relative to the scene, not to where one happens to stand
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    expected = render(scenes.parse(source).instantiate())
    assert expected.std() > 0.05
    copy = tmp_path / "copy"
    copy.mkdir()
    path = scenes.write(scenes.parse(source), copy)
    assert path == copy / "scene.xml"
    source.parent.rename(tmp_path / "gone")
    assert str(tmp_path) not in path.read_text()
    copy.rename(tmp_path / "moved")
    again = render(scenes.parse(tmp_path / "moved" / "scene.xml").instantiate())
    assert np.allclose(again, expected, atol=1e-5)
    files = [p for p in (tmp_path / "moved").rglob("*") if p.is_file()]
    assert len(files) == 4 and {p.suffix for p in files} == {".xml", ".ply", ".exr"}


@pytest.mark.parametrize("name", ["meshes/box.ply", "textures/paint.exr", "light/paint.exr"])
def test_a_missing_file_is_named_with_its_line(name, with_files):
    source = with_files(False)
    (source.parent / name).unlink()
    with pytest.raises(UserError, match=rf"scene.xml \(line \d+.*the file '{name}' does not exist"):
        scenes.parse(source)


def test_a_missing_scene_is_named(tmp_path):
    with pytest.raises(UserError, match=r"none.xml: no such scene file"):
        scenes.parse(tmp_path / "none.xml")


def test_a_scene_needs_light(parse):
    parsed = parse(BALL.format(DIFFUSE))
    emitters.require_emitters(parsed.instantiate(), parsed.path)
    dark = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}})
    with pytest.raises(UserError, match="the scene has no light source"):
        emitters.require_emitters(dark, parsed.path)


def test_a_scene_that_fails_does_not_disturb_the_next_one(parse):
    """A light without its shape stayed behind, and the next virtual call ended the process."""
    light = '<shape type="rectangle"><emitter type="area"/></shape>'
    kept = []
    for _ in range(2):
        with pytest.raises(UserError, match='Plugin "nothing" not found') as caught:
            parse(light + '<shape type="nothing"/>').instantiate()
        kept.append(caught)
    assert np.isfinite(render(parse(light + BALL.format(DIFFUSE)).instantiate(), 2)).all()


# -------------------------------------------------------------------------------------- lights

SKIES = {
    "constant": '<emitter type="constant" id="sky"/>',
    "envmap": '<emitter type="envmap"><string name="filename" value="bump.exr"/></emitter>',
    "sunsky": '<emitter type="sunsky"/>',
}
LAMP = (
    '<shape type="sphere" id="lamp"><point name="center" value="3,0,0"/>'
    '<emitter type="area"><rgb name="radiance" value="4 5 6"/></emitter></shape>'
)
#: Every kind of light, with the name and the strength that are told of it.
LIGHTS = {
    ("point light", (1, 2, 3)): '<emitter type="point">'
    '<rgb name="intensity" value="1 2 3"/></emitter>',
    ("bulb", (2.5, 2.5, 2.5)): '<emitter type="point" id="bulb">'
    '<float name="intensity" value="2.5"/></emitter>',
    ("spot light", (1, 1, 1)): '<emitter type="spot"/>',
    ("sun", None): '<emitter type="directional" id="sun"><spectrum type="blackbody" '
    'name="irradiance"><float name="temperature" value="5000"/></spectrum></emitter>',
    ("constant light", (1, 1, 1)): '<emitter type="constant"/>',
    ("lamp", (4, 5, 6)): LAMP,
    ("screen", None): '<shape type="rectangle" id="screen"><emitter type="area">'
    '<texture type="checkerboard" name="radiance"/></emitter></shape>',
    ("panel", (2, 2, 2)): '<shape type="rectangle"><emitter type="area" id="panel">'
    '<texture type="d65" name="radiance"><float name="scale" value="2"/></texture>'
    "</emitter></shape>",
    ("beam", (3, 3, 3)): '<shape type="rectangle"><emitter type="directionalarea" id="beam">'
    '<float name="radiance" value="3"/></emitter></shape>',
}  # fmt: skip


@pytest.fixture
def parse_lit(tmp_path):
    """A parsed scene of a ball and these emitters alone."""

    def run(content):
        write_exr(tmp_path / "bump.exr", np.random.default_rng(5).random((8, 16, 3)))
        path = tmp_path / "scene.xml"
        sky = '<emitter type="constant"><rgb name="radiance" value="1 1 1"/></emitter>'
        path.write_text(ROOM.replace(sky, "").format(BALL.format(DIFFUSE) + content))
        return scenes.parse(path)

    return run


def constant(*rgb):
    return mi.load_dict({"type": "constant", "radiance": {"type": "rgb", "value": list(rgb)}})


@pytest.mark.parametrize("kind", SKIES)
def test_an_environment_is_replaced_whatever_it_is(kind, parse_lit):
    parsed = parse_lit(SKIES[kind] + LAMP)
    edit.set_environment(parsed, constant(0.1, 0.2, 0.3))
    scene = parsed.instantiate()
    assert len(scene.emitters()) == 2  # the lamp stays
    np.testing.assert_allclose(
        emitters.environment_latlong(scene, 4), np.full((4, 8, 3), [0.1, 0.2, 0.3]), rtol=1e-5
    )


def test_a_scene_without_environment_has_none_to_fit(parse_lit):
    parsed = parse_lit(LAMP)
    with pytest.raises(UserError, match=r"scene.xml: the scene has no environment map to fit. Add"):
        edit.set_environment(parsed, constant(1, 1, 1))
    with pytest.raises(UserError, match="the scene has no environment map"):
        emitters.environment_latlong(parsed.instantiate(), 4)


def test_lights_are_told_by_name_and_strength(parse_lit):
    found = emitters.named_emitters(parse_lit("".join(LIGHTS.values())))
    assert len(found) == len(LIGHTS)
    told = {light.name: light.strength for light in found}
    assert told == {n: s if s is None else pytest.approx(s) for n, s in LIGHTS}


def test_no_two_lights_have_one_name(parse_lit):
    lights = '<emitter type="point"/>' * 3 + '<emitter type="spot"/>'
    names = [light.name for light in emitters.named_emitters(parse_lit(lights))]
    assert names == ["point light 1", "point light 2", "point light 3", "spot light"]


def test_a_light_without_an_id_has_the_name_of_its_file(built_in, tmp_path):
    parsed = scenes.parse(built_in("cornell"))
    assert [light.name for light in emitters.named_emitters(parsed)] == ["light_shape"]
    copied = scenes.parse(scenes.write(parsed, tmp_path))
    assert [light.name for light in emitters.named_emitters(copied)] == ["light"]


def test_every_light_gets_a_texture_of_its_own(parse_lit):
    parsed = parse_lit("".join(LIGHTS.values()))
    before = emitters.named_emitters(parsed)

    def make(count):
        strengths = Emission(count, scale=1.0)
        numbers = np.arange(3 * count, dtype=np.float32)
        strengths.assign({"log": mi.Float(np.log(numbers + 1))})
        strengths.prepare()
        return emission_textures(strengths)

    assert edit.set_emission(parsed, make) == before
    strengths = [light.strength for light in emitters.named_emitters(parsed)]
    np.testing.assert_allclose(np.ravel(strengths), np.arange(27) + 1, rtol=1e-5)
    shown = " ".join(str(emitter) for emitter in parsed.instantiate().emitters())
    assert all(f"Strength[{i}]" in shown for i in range(9))


@pytest.mark.parametrize("kind", ["envmap", "sunsky"])
def test_a_scene_lit_by_its_environment_alone_has_no_light_to_fit(kind, parse_lit):
    parsed = parse_lit(SKIES[kind])
    assert emitters.named_emitters(parsed) == []
    with pytest.raises(UserError, match=r"scene.xml: the scene has no light to fit: no area") as e:
        edit.set_emission(parsed, lambda count: [])
    assert "--unknown lighting" in str(e.value) and "\n" not in str(e.value)
