"""Emitters and the environment: named, told with their strength, replaced by unknowns."""

import mitsuba as mi
import numpy as np
import pytest
from scene_texts import BALL, DIFFUSE

from unbake.errors import UserError
from unbake.fields.emission import Emission, emission_textures
from unbake.imaging.pictures import write_exr
from unbake.scene import edit, emitters
from unbake.scene import parse as scenes


def test_a_scene_needs_light(parse):
    parsed = parse(BALL.format(DIFFUSE))
    emitters.require_emitters(parsed.instantiate(), parsed.path)
    dark = mi.load_dict({"type": "scene", "ball": {"type": "sphere"}})
    with pytest.raises(UserError, match="the scene has no light source"):
        emitters.require_emitters(dark, parsed.path)


SKIES = {
    "constant": '<emitter type="constant" id="sky"/>',
    "envmap": '<emitter type="envmap"><string name="filename" value="bump.exr"/></emitter>',
    "sunsky": '<emitter type="sunsky"/>',
}
LAMP = (
    '<shape type="sphere" id="lamp"><point name="center" value="3,0,0"/>'
    '<emitter type="area"><rgb name="radiance" value="4 5 6"/></emitter></shape>'
)
#: The mean of the picture that the scenes here have.
PICTURE = tuple(np.random.default_rng(5).random((8, 16, 3)).mean((0, 1)).tolist())
#: Every kind of light, with the name and the strength that are told of it.
LIGHTS = {
    ("point light", (1, 2, 3)): '<emitter type="point">'
    '<rgb name="intensity" value="1 2 3"/></emitter>',
    ("bulb", (2.5, 2.5, 2.5)): '<emitter type="point" id="bulb">'
    '<float name="intensity" value="2.5"/></emitter>',
    ("spot light", (1, 1, 1)): '<emitter type="spot"/>',
    ("sun", (5, 4, 3)): '<emitter type="directional" id="sun">'
    '<rgb name="irradiance" value="5 4 3"/></emitter>',
    ("constant light", (1, 1, 1)): '<emitter type="constant"/>',
    ("lamp", (4, 5, 6)): LAMP,
    ("screen", PICTURE): '<shape type="rectangle" id="screen"><emitter type="area">'
    '<texture type="bitmap" name="radiance"><string name="filename" value="bump.exr"/></texture>'
    '</emitter></shape>',
    ("panel", (2, 2, 2)): '<shape type="rectangle"><emitter type="area" id="panel">'
    '<texture type="d65" name="radiance"><float name="scale" value="2"/></texture>'
    "</emitter></shape>",
    ("beam", (3, 3, 3)): '<shape type="rectangle"><emitter type="directionalarea" id="beam">'
    '<float name="radiance" value="3"/></emitter></shape>',
}  # fmt: skip


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


@pytest.mark.parametrize("kind", SKIES)
def test_lights_besides_an_environment_are_counted_unless_they_are_black(kind, parse_lit):
    black = LAMP.replace("4 5 6", "0 0 0").replace('id="lamp"', 'id="off"')
    alone, lit = parse_lit(SKIES[kind] + black), parse_lit(SKIES[kind] + black + LAMP)
    assert emitters.lights_besides(alone, emitters.ENVIRONMENTS) == 0
    assert emitters.lights_besides(lit, emitters.ENVIRONMENTS) == 1
    assert emitters.lights_besides(lit, tuple(emitters.STRENGTHS)) == (kind != "constant")


def test_lights_are_told_by_name_and_strength(parse_lit):
    found = emitters.named_emitters(parse_lit("".join(LIGHTS.values())))
    assert len(found) == len(LIGHTS)
    told = {light.name: light.strength for light in found}
    assert told == {n: pytest.approx(s, rel=1e-3) for n, s in LIGHTS}
    assert [light.name for light in found if light.varies] == ["screen"]


def test_pictures_of_lamps_are_told_by_their_mean(parse_lit, tmp_path):
    parsed = parse_lit("".join(LIGHTS.values()))
    found = emitters.pictures(parsed)
    names = [light.name for light in emitters.named_emitters(parsed)]
    (picture,) = (p for p in found if p is not None)
    assert found.index(picture) == names.index("screen")
    pixels = np.random.default_rng(5).random((8, 16, 3))
    np.testing.assert_allclose(picture.sampled(), pixels / PICTURE, rtol=2e-3)
    # Texels are all counted, of large pictures too; and what a lamp shows of one that is placed.
    large = np.zeros((8, 2048, 3), np.float32)
    large[:, ::1024] = 1024
    write_exr(tmp_path / "large.exr", large)
    more = '<transform name="to_uv"><scale value="{}"/></transform>'
    # A quarter of it begins within the first bright texel, of which it has seven eighths.
    for placed, mean in (("", 1.0), (more.format("3"), 1.0), (more.format("0.25"), 1.75)):
        text = LIGHTS["screen", PICTURE].replace("bump.exr", str(tmp_path / "large.exr"))
        text = text.replace("</texture>", placed + "</texture>")
        (only,) = emitters.pictures(parse_lit(text))
        assert only.mean == pytest.approx((mean,) * 3, rel=0.02)
        assert only.sampled_by_it  # a rectangle
    # A channel that is black has no picture; one that is black all over is no picture.
    for factors in ((1, 0, 1), (0, 0, 0)):
        parsed = parse_lit("".join(LIGHTS.values()))
        write_exr(tmp_path / "bump.exr", pixels * factors)
        shown = [p for p in emitters.pictures(parsed) if p is not None]
        assert len(shown) == (sum(factors) > 0)
        for p in shown:
            np.testing.assert_allclose(p.sampled()[..., 1], 1)
            np.testing.assert_allclose(p.sampled()[..., 0], pixels[..., 0] / p.mean[0], rtol=1e-5)


def test_intensities_are_of_the_order_of_a_squared_distance(parse_lit):
    """Of what is seen from there; where nothing is, of the middle of the scene or its corners."""
    far = '<emitter type="point"><point name="position" value="0,0,9"/></emitter>'
    inside = '<emitter type="spot"/>'
    parsed = parse_lit(far + LAMP + inside)
    places = emitters.places(parsed)
    names = [light.name for light in emitters.named_emitters(parsed)]
    assert dict(zip(names, [p is None for p in places], strict=True)) == {
        "point light": False,
        "lamp": True,
        "spot light": False,
    }
    scene = parsed.instantiate()
    found = dict(zip(names, emitters.squared_distances(scene, places), strict=True))
    assert found["lamp"] == 1 and found["spot light"] == pytest.approx(1, rel=0.01)
    assert 8**2 < found["point light"] < 9.5**2
    away = emitters.squared_distances(scene, [np.array([1e3, 0.0, 0.0])])
    low, high = np.ravel(scene.bbox().min), np.ravel(scene.bbox().max)
    assert away == [pytest.approx(np.linalg.norm([1e3, 0, 0] - (low + high) / 2) ** 2, rel=1e-3)]
    assert emitters.squared_distances(mi.load_dict({"type": "scene"}), [np.zeros(3)]) == [1.0]


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


@pytest.mark.parametrize(
    "strength",
    ['<string name="radiance" value="bright"/>', '<texture name="radiance" type="checkers"/>'],
)
def test_a_strength_that_is_none_is_told(strength, parse):
    """Lights are named before Mitsuba makes the scene, which would complain of them itself."""
    parsed = parse(BALL.format(f'<emitter type="area">{strength}</emitter>'))
    with pytest.raises(UserError, match=r"scene.xml: 'radiance' of area is no strength: "):
        emitters.named_emitters(parsed)
