"""Bump maps that are flat in places, on surfaces in all positions."""

import itertools

import mitsuba as mi
import numpy as np
import pytest
from scene_texts import render

from unbake.imaging.pictures import write_exr
from unbake.scene.parse import parse, write

SCENE = """<scene version="3.0.0">
  <sensor type="perspective"><float name="fov" value="60"/>
    <transform name="to_world"><lookat origin="{eye}" target="0,0,0" up="{up}"/></transform>
    <film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="12"/>
      <rfilter type="box"/></film></sensor>
  <emitter type="constant"/>
  <shape type="{kind}">{transform}{file}<bsdf type="twosided">{bsdf}</bsdf></shape>
</scene>"""
BUMPS = '<bsdf type="bumpmap"><texture type="bitmap"><string name="filename" value="bump.exr"/>'
BUMPS += '<boolean name="raw" value="true"/></texture><float name="scale" value="0.1"/>{}</bsdf>'
MATTE = '<bsdf type="principled"><float name="roughness" value="0.4"/></bsdf>'
AXES = ("x", "y", "z")


def turns():
    """Transforms that take a surface to all positions along the axes."""
    for (first, a), (second, b) in itertools.product(
        itertools.product(AXES, (0, 90)), itertools.product(AXES, (0, 90, 180, 270))
    ):
        inner = f'<rotate {first}="1" angle="{a}"/><rotate {second}="1" angle="{b}"/>'
        yield f'<transform name="to_world">{inner}</transform>'


def picture(folder, kind, transform, bsdf, file=""):
    """A scene that is seen from a corner, path traced: (12, 12, 3)."""
    eye, up = "3,2.5,2", "0,1,0"
    text = SCENE.format(eye=eye, up=up, kind=kind, transform=transform, file=file, bsdf=bsdf)
    (folder / "scene.xml").write_text(text)
    return render(parse(folder / "scene.xml").instantiate())


@pytest.mark.parametrize("kind", ["rectangle", "cube", "ply"])
def test_flat_places_of_bump_maps_are_as_without(kind, tmp_path):
    """Whatever direction textures run in: Mitsuba's own frame is NaN along the z axis."""
    write_exr(tmp_path / "bump.exr", np.zeros((8, 8)))
    mi.load_dict({"type": "rectangle"}).write_ply(str(tmp_path / "wall.ply"))
    file = '<string name="filename" value="wall.ply"/>' if kind == "ply" else ""
    for transform in turns():
        bumpy = picture(tmp_path, kind, transform, BUMPS.format(MATTE), file)
        plain = picture(tmp_path, kind, transform, MATTE, file)
        assert np.isfinite(bumpy).all() and bumpy.max() > 0.1
        # Tangents differ, and so do the directions of the same random numbers.
        np.testing.assert_allclose(bumpy, plain, atol=0.1)
        assert bumpy.mean() == pytest.approx(plain.mean(), abs=5e-3)


def test_bumps_still_show(tmp_path):
    waves = np.sin(np.linspace(0, 25, 64))[None, :] * np.ones((64, 1))
    write_exr(tmp_path / "bump.exr", waves)
    bumpy = picture(tmp_path, "cube", "", BUMPS.format(MATTE))
    assert np.isfinite(bumpy).all()
    assert np.abs(bumpy - picture(tmp_path, "cube", "", MATTE)).max() > 0.05


def test_copies_of_scenes_are_not_turned(tmp_path):
    """Each reading would turn them once more."""
    write_exr(tmp_path / "bump.exr", np.zeros((8, 8)))
    bsdf = BUMPS.format(MATTE)
    text = SCENE.format(eye="3,2,2", up="0,1,0", kind="rectangle", transform="", file="", bsdf=bsdf)
    (tmp_path / "scene.xml").write_text(text)
    (tmp_path / "copy").mkdir()
    copied = parse(write(parse(tmp_path / "scene.xml"), tmp_path / "copy"))
    (wall,) = [n for n in copied.state.nodes if n.props.plugin_name() == "rectangle"]
    assert "to_world" not in wall.props
