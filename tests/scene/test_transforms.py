"""Transforms of copied scenes are those of the original, however large or small."""

import itertools

import mitsuba as mi
import numpy as np
import pytest

from unbake.scene.parse import is_reference, parse, referenced, write

SCENE = """<scene version="3.0.0">
  <sensor type="perspective"><transform name="to_world">
    <lookat origin="{k},{k},{k}" target="0,0,0" up="0,1,0"/></transform></sensor>
  <shape type="sphere"><point name="center" x="{k}" y="1" z="2"/>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.2 0.3 0.4"/></bsdf></shape>
  <emitter type="envmap"><string name="filename" value="sky.exr"/><transform name="to_world">
    <scale value="{k}"/><rotate x="1" angle="90"/></transform></emitter>
  <shape type="sphere"><emitter type="area"/><transform name="to_world">
    <scale value="{k}"/><translate x="{k}"/></transform></shape>
  <shape type="cube"><transform name="to_world">
    <scale x="{k}" y="{half}" z="{thin}"/><rotate y="1" x="0.3" angle="{angle}"/>
    <translate x="{k}" y="1" z="2"/></transform>
    <bsdf type="principled"><float name="specular" value="0.4"/>
      <texture type="checkerboard" name="base_color">
      <transform name="to_uv"><scale x="{k}" y="{half}"/><rotate z="1" angle="{angle}"/>
      <translate x="2"/></transform></texture></bsdf></shape>
</scene>"""


def transforms(scene):
    """All transforms by plugin and name, (4, 4) float64."""
    return {
        (node.props.plugin_name(), key): np.array(node.props[key].matrix, np.float64)
        for node in scene.state.nodes
        for key in list(node.props)
        if isinstance(node.props[key], mi.ScalarAffineTransform4d)
    }


@pytest.mark.parametrize("angle", [0, 90, 33])
@pytest.mark.parametrize("size", [1e-4, 1e-2, 0.3, 1, 19, 21, 300, 3000, 1e6])
def test_transforms_are_written_as_they_are(size, angle, tmp_path):
    mi.Bitmap(np.ones((4, 8, 3), np.float32)).write(str(tmp_path / "sky.exr"))
    numbers = {"k": size, "half": size / 2, "thin": size / 500, "angle": angle}
    (tmp_path / "scene.xml").write_text(SCENE.format(**numbers))
    original = parse(tmp_path / "scene.xml")
    before = transforms(original)
    (tmp_path / "copy").mkdir()
    copied = transforms(parse(write(original, tmp_path / "copy")))
    assert len(before) == 5 and copied.keys() == before.keys()
    for key, matrix in before.items():
        least = np.abs(matrix[:3, :3]).max(axis=0).clip(1e-12)
        error = np.abs(copied[key][:3, :3] - matrix[:3, :3]) / least
        assert error.max() < 1e-6, key
        np.testing.assert_allclose(copied[key][:3, 3], matrix[:3, 3], rtol=1e-6, atol=1e-9)
    for key, matrix in transforms(original).items():
        np.testing.assert_array_equal(matrix, before[key])


@pytest.mark.parametrize("axis", ["x", "y", "z"])
@pytest.mark.parametrize("angle", [0, 90, 180, 270, 33])
def test_mirrors_are_written_as_they_are(axis, angle, tmp_path):
    signs = np.array(list(itertools.product((1, -1), repeat=3)))
    shapes = [
        f'<shape type="cube"><transform name="to_world"><scale x="{2 * x}" y="{3 * y}" z="{z}"/>'
        f'<rotate {axis}="1" angle="{angle}"/><translate x="1" y="2" z="{n}"/></transform></shape>'
        for n, (x, y, z) in enumerate(signs)
    ]
    (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0">{"".join(shapes)}</scene>')
    original = parse(tmp_path / "scene.xml")
    (tmp_path / "copy").mkdir()
    copied = parse(write(original, tmp_path / "copy"))
    kinds = [
        [np.array(n.props["to_world"].matrix) for n in scene.state.nodes if "to_world" in n.props]
        for scene in (original, copied)
    ]
    assert len(kinds[0]) == len(signs)
    np.testing.assert_allclose(kinds[0], kinds[1], atol=1e-9)


def test_what_nothing_refers_to_is_not_missed(tmp_path):
    """Exports and other lights take shapes and environments from a scene, and leave their nodes."""
    mi.Bitmap(np.ones((4, 8, 3), np.float32)).write(str(tmp_path / "sky.exr"))
    (tmp_path / "scene.xml").write_text(SCENE.format(k=-300, half=1, thin=0.5, angle=90))
    scene = parse(tmp_path / "scene.xml")
    root = scene.state.root.props
    for key in list(root):
        if is_reference(root[key]) and referenced(scene, root[key]).props.plugin_name() != "cube":
            del root[key]
    (tmp_path / "copy").mkdir()
    copied = transforms(parse(write(scene, tmp_path / "copy")))
    assert copied.keys() == {("cube", "to_world"), ("checkerboard", "to_uv")}
    for key, matrix in copied.items():
        np.testing.assert_allclose(matrix, transforms(scene)[key], atol=1e-9)


def test_usual_transforms_stay_readable(tmp_path):
    mi.Bitmap(np.ones((4, 8, 3), np.float32)).write(str(tmp_path / "sky.exr"))
    (tmp_path / "scene.xml").write_text(SCENE.format(k=2, half=1, thin=0.5, angle=0))
    (tmp_path / "copy").mkdir()
    text = write(parse(tmp_path / "scene.xml"), tmp_path / "copy").read_text()
    assert "<matrix" not in text and '<scale value="2"/>' in text and "<lookat" in text
