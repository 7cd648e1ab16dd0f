"""Textures where Mitsuba cannot use them, or reads them in another way than one would think."""

import mitsuba as mi
import numpy as np
import pytest
from scene_texts import BALL

from unbake.errors import UserError
from unbake.scene.edit import show_as_albedo
from unbake.scene.normals import repair_normals

CHECKS = '<texture type="checkerboard" name="{}"/>'
BUMPS = '<texture type="bitmap"><string name="filename" value="bump.exr"/></texture>'
COLOURS = (
    '<texture type="mesh_attribute" name="base_color"><string name="name" value="{}"/></texture>'
)
MATTE = '<bsdf type="diffuse"/>'


@pytest.mark.parametrize(
    ("shape", "fault"),
    [
        (
            f'<bsdf type="bumpmap">{CHECKS.format("a")}{MATTE}</bsdf>',
            "a bumpmap cannot read a check",
        ),
        (
            f'<bsdf type="normalmap">{CHECKS.format("normalmap")}{MATTE}</bsdf>',
            "a normalmap cannot",
        ),
        (f'<bsdf type="bumpmap">{BUMPS}<bsdf type="mask">{MATTE}</bsdf></bsdf>', "around a mask"),
        (
            f'<emitter type="area">{CHECKS.format("radiance")}</emitter>',
            "radiance of a lamp cannot",
        ),
    ],
)
def test_what_mitsuba_cannot_read_is_refused_with_its_line(shape, fault, parse):
    with pytest.raises(UserError, match=rf"scene.xml \(line.*{fault}"):
        parse(BALL.format(shape))


def test_colours_of_vertices_are_refused_in_instances_alone(parse):
    def scene(name):
        bsdf = f'<bsdf type="principled">{COLOURS.format(name)}</bsdf>'
        group = f'<shape type="shapegroup" id="g"><shape type="cube">{bsdf}</shape></shape>'
        return f'{group}<shape type="instance"><ref id="g"/></shape>'

    parse(scene("face_color"))
    with pytest.raises(
        UserError, match=r"vertices have colours have other colours. Place the mesh"
    ):
        parse(scene("vertex_color"))


@pytest.mark.parametrize(
    "texture",
    [
        '<texture type="checkerboard" name="roughness"><rgb name="color0" value="0.2"/>'
        '<rgb name="color1" value="0.8"/></texture>',
        '<texture type="bitmap" name="roughness"><string name="filename" value="bump.exr"/>'
        '<boolean name="raw" value="true"/></texture>',
        '<float name="roughness" value="0.3"/>',
        '<rgb name="roughness" value="0.3"/>',
        "",
    ],
    ids=["checkerboard", "bitmap", "number", "grey", "default"],
)
def test_true_numbers_are_those_that_mitsuba_renders(texture, parse):
    """BSDFs read them by another method than colours: squares of a checkerboard change places."""
    parsed = parse(f'<shape type="rectangle"><bsdf type="principled">{texture}</bsdf></shape>')
    (bsdf,) = parsed.principled_nodes()
    rendered = None
    if texture and "<texture" not in texture:
        rendered = bsdf.props.get_texture("roughness", 0.5)
    if "<texture" in texture:
        index = bsdf.props["roughness"].index()
        rendered = mi.PluginManager.instance().create_object(parsed.state.nodes[index].props)
        rendered = (rendered.expand() or [rendered])[0]
    show_as_albedo(parsed, "roughness", 0.5)
    scene = parsed.instantiate()
    rng = np.random.default_rng(0)
    x, y = (mi.Float(rng.uniform(-0.9, 0.9, 200).astype(np.float32)) for _ in range(2))
    ray = mi.Ray3f(mi.Point3f(x, y, 3), mi.Vector3f(0, 0, -1))
    si = scene.ray_intersect(ray)
    shown = np.array(si.bsdf().eval_diffuse_reflectance(si))
    expected = np.full(200, 0.5) if rendered is None else np.array(rendered.eval_1(si))
    np.testing.assert_allclose(shown, np.broadcast_to(expected, (3, 200)), atol=1e-5)


def test_shells_of_fog_are_left_out_with_it(parse):
    fog = '<medium name="interior" type="homogeneous"/>'
    shell = f'<shape type="cube"><bsdf type="null"/>{fog}</shape>'
    inside = BALL.format(MATTE)
    scene = parse(shell + inside)
    assert scene.media == 1 and len(scene.instantiate().shapes()) == 1
    kept = parse(f'<shape type="cube"><bsdf type="dielectric"/>{fog}</shape>' + inside)
    assert kept.media == 1 and len(kept.instantiate().shapes()) == 2


def test_normals_that_are_none_become_those_of_their_triangles(tmp_path):
    """Mitsuba leaves normals as its memory was where some faces of an OBJ file have none."""
    mesh = mi.load_dict({"type": "sphere"}) and mi.Mesh("m", 3, 1, has_vertex_normals=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = np.array([0, 0, 0, 1, 0, 0, 0, 1, 0], np.float32)
    params["faces"] = np.array([0, 1, 2], np.uint32)
    params["vertex_normals"] = np.array([0, 0, 1, 0, 0, 0, 3e30, 0, 0], np.float32)
    params.update()
    assert repair_normals(mi.load_dict({"type": "scene", "mesh": mesh})) == 2
    normals = np.array(mi.traverse(mesh)["vertex_normals"]).reshape(3, 3)
    np.testing.assert_allclose(normals, [[0, 0, 1]] * 3, atol=1e-6)


def coloured(file, fields):
    """A PLY file of a triangle whose vertices have these further properties."""
    lines = ["ply", "format ascii 1.0", "element vertex 3"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"property uchar {name}" for name in fields]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    more = " ".join(["200"] * len(fields))
    lines += [f"{corner} {more}" for corner in ("0 0 0", "1 0 0", "0 1 0")]
    file.write_text("\n".join([*lines, "3 0 1 2"]) + "\n")


@pytest.mark.parametrize(
    ("fields", "fault"),
    [
        (("red", "green", "blue"), None),
        (("red", "green", "blue", "alpha"), "has an alpha, and is not read"),
        ((), "the mesh has no vertex_color"),
    ],
)
def test_colours_that_mitsuba_takes_for_black_are_refused(fields, fault, parse, tmp_path):
    coloured(tmp_path / "scan.ply", fields)
    bsdf = f'<bsdf type="principled">{COLOURS.format("vertex_color")}</bsdf>'
    shape = f'<shape type="ply"><string name="filename" value="scan.ply"/>{bsdf}</shape>'
    if fault is not None:
        with pytest.raises(UserError, match=f"{fault}. Write it as PLY"):
            parse(shape)
        return
    scene = parse(shape).instantiate()
    ray = mi.Ray3f(mi.Point3f(0.2, 0.2, 3), mi.Vector3f(0, 0, -1))
    si = scene.ray_intersect(ray)
    assert np.array(si.bsdf().eval_diffuse_reflectance(si)).min() > 0.1
