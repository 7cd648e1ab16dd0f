"""Numbers and pictures that no surface and no light has: all are told, and where."""

import re

import mitsuba as mi
import numpy as np
import pytest
from scene_texts import BALL

from unbake.imaging.pictures import write_exr
from unbake.scene.edit import to_principled
from unbake.scene.values import attribute_faults, value_faults

BITMAP = '<texture type="bitmap" name="{}"><string name="filename" value="{}.exr"/></texture>'
CHECKS = (
    '<texture type="checkerboard" name="base_color"><rgb name="color0" value="0.1 0.2 0.3"/>'
    '<rgb name="color1" value="0.3 {} 0.2"/></texture>'
)
LIGHT = '<emitter type="point"><rgb name="intensity" value="{}"/></emitter>'


@pytest.fixture
def told(parse, tmp_path):
    """What is wrong with a scene of a ball of this BSDF, and of more."""

    def run(plugin, inner, more=""):
        rng = np.random.default_rng(2)
        good = rng.random((8, 8, 3)).astype(np.float32)
        files = {"good": good, "bright": 3 * good, "negative": good - 0.5, "nan": good.copy()}
        files["nan"][2, 3, 1] = np.nan
        for name, pixels in files.items():
            write_exr(tmp_path / f"{name}.exr", pixels)
        parsed = parse(BALL.format(f'<bsdf type="{plugin}">{inner}</bsdf>') + more)
        to_principled(parsed)
        return [str(fault) for fault in value_faults(parsed)]

    return run


@pytest.mark.parametrize(
    ("plugin", "inner", "expected"),
    [
        ("diffuse", '<rgb name="reflectance" value="0.2 0.9 1"/>', None),
        ("diffuse", '<float name="reflectance" value="1.7"/>', "'base_color' is 1.7, not from 0"),
        ("diffuse", '<spectrum name="reflectance" value="1.7"/>', "'base_color' is 1.7, not"),
        ("diffuse", BITMAP.format("reflectance", "bright"), r"bright.exr: \d+ pixels of 'base_co"),
        (
            "roughplastic",
            '<float name="alpha" value="4"/>',
            "'roughness' is 2, not from 0 to 1. No surface has that",
        ),
        ("principled", BITMAP.format("base_color", "good"), None),
        ("principled", BITMAP.format("base_color", "negative"), "but -0.4[^ ]* to 0.4"),
        ("principled", BITMAP.format("base_color", "nan"), "nan.exr: 1 pixels of base_color are N"),
        ("principled", BITMAP.format("roughness", "bright"), "'roughness' are not from 0 to 1"),
        ("principled", BITMAP.format("metallic", "good"), None),
        ("principled", CHECKS.format(0.9), None),
        ("principled", CHECKS.format(1.7), "'color1' is 0.2 to 1.7, not from 0 to 1"),
    ],
)
def test_what_surfaces_reflect(plugin, inner, expected, told):
    found = told(plugin, inner)
    assert len(found) == (expected is not None)
    assert expected is None or re.search(expected, found[0])


@pytest.mark.parametrize(
    ("light", "expected"),
    [
        (LIGHT.format("1 0 3"), None),
        (LIGHT.format("1 0 -3"), "'intensity' of the light is -3. No light is negative"),
        ('<emitter type="envmap"><string name="filename" value="good.exr"/></emitter>', None),
        (
            '<emitter type="envmap"><string name="filename" value="negative.exr"/></emitter>',
            r"negative.exr: \d+ pixels of the environment map are negative. Set them to zero",
        ),
        (
            '<emitter type="envmap"><float name="scale" value="-1"/>'
            '<string name="filename" value="good.exr"/></emitter>',
            "'scale' of the light is -1",
        ),
        (
            '<shape type="sphere"><emitter type="area">'
            '<texture type="bitmap" name="radiance"><string name="filename" value="nan.exr"/>'
            "</texture></emitter></shape>",
            "nan.exr: 1 pixels of radiance are NaN",
        ),
    ],
)
def test_what_lights_give(light, expected, told, parse_lit):
    found = told("diffuse", "", light) if "envmap" not in light else lit(light, told, parse_lit)
    assert len(found) == (expected is not None)
    assert expected is None or re.search(expected, found[0])


def lit(light, told, parse_lit):
    """The same of a scene without another environment."""
    told("diffuse", "")
    return [str(fault) for fault in value_faults(parse_lit(light))]


def test_all_are_told(told):
    inner = BITMAP.format("base_color", "bright") + BITMAP.format("roughness", "negative")
    assert len(told("principled", inner, LIGHT.format("-1 0 0"))) == 3


@pytest.mark.parametrize("shape", ["sphere", "cube"])
def test_values_that_a_mesh_does_not_have_are_told(shape, parse):
    texture = '<texture type="mesh_attribute" name="base_color">{}</texture>'
    name = '<string name="name" value="vertex_tint"/>'
    bsdf = f'<bsdf type="principled">{texture.format(name)}</bsdf>'
    parsed = parse("".join(f'<shape type="{shape}" id="{x}">{bsdf}</shape>' for x in "ab"))
    scene = parsed.instantiate(merge=False)
    assert [fault.what for fault in attribute_faults(scene, parsed.path)] == [
        f"the shape '{x}' has no 'vertex_tint', which its material reads" for x in "ab"
    ]
    (fault,) = attribute_faults(parse(f'<shape type="{shape}">{bsdf}</shape>').instantiate(), "a")
    assert "the shape ''" not in fault.what and "'vertex_tint'" in fault.what
    assert "tint_x" in str(fault)


def test_values_that_a_mesh_has_are_taken():
    texture = {"type": "mesh_attribute", "name": "vertex_tint"}
    cube = mi.load_dict({"type": "cube", "bsdf": {"type": "principled", "base_color": texture}})
    cube.add_attribute("vertex_tint", 3, np.full(3 * cube.vertex_count(), 0.5))
    assert not attribute_faults(mi.load_dict({"type": "scene", "cube": cube}), "scene.xml")
