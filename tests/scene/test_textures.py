"""What Mitsuba or a fit cannot use is refused; other textures are read as Mitsuba reads them."""

import mitsuba as mi
import numpy as np
import pytest
from scene_texts import BALL, WRAPPERS

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


METAL = '<bsdf type="roughconductor"/>'
BOTH = '<bsdf type="twosided">{}{}</bsdf>'
BLEND = '<bsdf type="blendbsdf"><float name="weight" value="0.2"/>{}{}</bsdf>'


@pytest.mark.parametrize(
    "sides",
    [(MATTE, METAL), ('<bsdf type="principled"/>', MATTE), (METAL, BLEND.format(MATTE, METAL))],
    ids=["one to fit", "two to fit", "in a blend"],
)
def test_two_sides_of_unlike_materials_are_refused_with_their_line(sides, parse):
    """One material was fitted to both."""
    both = BOTH.format(*sides)
    with pytest.raises(UserError, match=r"scene.xml \(line.*the two sides .*shape of its own"):
        parse(BALL.format(both))
    parse(both.replace("<bsdf", '<bsdf id="unused"', 1) + BALL.format(MATTE))


def test_two_sides_may_be_known_or_alike(parse):
    shared = '<bsdf type="diffuse" id="matte"/>'
    alike = BOTH.format('<ref name="front" id="matte"/>', '<ref name="back" id="matte"/>')
    known = BOTH.format(METAL, '<bsdf type="conductor"/>')
    scene = parse(shared + BALL.format(alike) + BALL.format(known))
    assert len(scene.instantiate(merge=False).shapes()) == 2


OPEN = {
    "null": '<bsdf type="null"/>',
    "thin": '<bsdf type="thindielectric"/>',
    "mask": f'<bsdf type="mask">{MATTE}</bsdf>',
}


@pytest.mark.parametrize("name", OPEN)
@pytest.mark.parametrize("around", WRAPPERS)
def test_blends_that_let_light_pass_are_refused_with_their_line(around, name, parse):
    """No light that bounces find arrived at them, and fits were too bright."""
    for blend in (BLEND.format(MATTE, OPEN[name]), BLEND.format(OPEN[name], METAL)):
        shape = BALL.format(WRAPPERS[around].format(blend))
        with pytest.raises(UserError, match=r"scene.xml \(line.*a blend with a BSDF that .*a mask"):
            parse(shape)
        with pytest.raises(UserError, match="a blend with a BSDF that lets light pass"):
            parse(f'<shape type="shapegroup" id="group">{shape}</shape>')


def test_blends_that_no_shape_has_and_masks_around_blends_are_taken(parse):
    unused = BLEND.format(MATTE, OPEN["null"]).replace("<bsdf", '<bsdf id="unused"', 1)
    masked = f'<bsdf type="mask">{BLEND.format(MATTE, METAL)}</bsdf>'
    assert parse(unused + BALL.format(masked)).instantiate()


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


def coloured(file, fields, kind="float", value=0.4):
    """A PLY file of a triangle whose vertices have these further properties."""
    lines = ["ply", "format ascii 1.0", "element vertex 3"]
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"property {kind} {name}" for name in fields]
    lines += ["element face 1", "property list uchar int vertex_indices", "end_header"]
    more = " ".join([str(value)] * len(fields))
    lines += [f"{corner} {more}" for corner in ("0 0 0", "1 0 0", "0 1 0")]
    file.write_text("\n".join([*lines, "3 0 1 2"]) + "\n")


@pytest.mark.parametrize(
    ("fields", "kind", "fault"),
    [
        (("red", "green", "blue"), "float", None),
        (("r", "g", "b"), "double", None),
        (("color_0", "color_1", "color_2"), "float", None),
        (("red", "green", "blue", "alpha"), "float", "has an alpha, and is not read"),
        ((), "float", "the mesh has no vertex_color"),
        (("red", "green", "blue"), "uchar", "has integers, of which Mitsuba makes albedo up to"),
        (("r", "g", "b"), "ushort", "has integers, of which Mitsuba makes albedo up to"),
    ],
)
def test_colours_that_mitsuba_takes_for_others_are_refused(fields, kind, fault, parse, tmp_path):
    coloured(tmp_path / "scan.ply", fields, kind, 200 if "u" in kind[:2] else 0.4)
    bsdf = f'<bsdf type="principled">{COLOURS.format("vertex_color")}</bsdf>'
    shape = f'<shape type="ply"><string name="filename" value="scan.ply"/>{bsdf}</shape>'
    if fault is not None:
        with pytest.raises(UserError, match=f"{fault}.*Write it as PLY"):
            parse(shape)
        return
    scene = parse(shape).instantiate()
    ray = mi.Ray3f(mi.Point3f(0.2, 0.2, 3), mi.Vector3f(0, 0, -1))
    si = scene.ray_intersect(ray)
    assert np.array(si.bsdf().eval_diffuse_reflectance(si)) == pytest.approx(0.4, rel=1e-3)
