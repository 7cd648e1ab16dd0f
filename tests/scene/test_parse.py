"""Scenes are read and copied with all their files; what is missing is named."""

from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import pytest
from scene_texts import BALL, DIFFUSE, ROOM, render

from unbake.errors import UserError
from unbake.imaging.pictures import write_exr
from unbake.scene import parse as scenes
from unbake.scene.edit import material_names, require_optimized
from unbake.scene.emitters import named_emitters
from unbake.scene.free_space import surface_area
from unbake.transport.vertex import rays_behind_area_emitters


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


NAMED = """<shape type="rectangle" id="panel"><emitter type="area"/></shape>
  <shape type="rectangle" id="wall.1"><transform name="to_world"><scale value="300"/></transform>
    </shape>
  <shape type="sphere"><emitter type="area"/></shape>
  <shape type="sphere" id="_unnamed_7"/><shape type="cube" id="__1"/>
  <shape type="disk" id="elm__2"/>
  <shape type="shapegroup" id="stack"><shape type="cube" id="block"/></shape>
  <shape type="instance" id="first"><ref id="stack"/></shape>
  <shape type="instance"><ref id="stack"/></shape>
  <shape type="ply" id="{name}"><string name="filename" value="meshes/box.ply"/></shape>"""


@pytest.mark.parametrize("name", ["chest", "box_shape"])
def test_a_copy_has_the_names_of_shapes(name, parse, tmp_path):
    mesh, copy = mi.load_dict({"type": "cube"}), tmp_path / "copy"
    (tmp_path / "meshes").mkdir()
    mesh.write_ply(str(tmp_path / "meshes" / "box.ply"))
    copy.mkdir()
    scene = parse(NAMED.format(name=name))
    before = [(node.props.id(), list(node.props)) for node in scene.state.nodes]
    path = scenes.write(scene, copy)
    assert [(node.props.id(), list(node.props)) for node in scene.state.nodes] == before
    written = ElementTree.parse(path).getroot()
    # The built-in scenes name shapes so, and all know them by their files.
    mine = None if name == "box_shape" else name
    shapes = [shape.get("id") for shape in written.findall("shape")]
    given = ["panel", "wall.1", None, None, None, None, "stack", "first", None, mine]
    assert shapes == given
    assert [shape.get("id") for shape in written.findall("shape/shape")] == ["block"]
    again = scenes.parse(path)
    lights = [light.name for light in named_emitters(again)]
    assert lights == ["constant light", "panel", "area light"]
    assert again.instantiate(merge=False).shapes()


def test_a_copy_may_have_dollars_in_its_names(parse, tmp_path):
    """As converters of FBX write them: to Mitsuba a dollar begins a parameter, unless escaped."""
    mesh, copy = mi.load_dict({"type": "cube"}), tmp_path / "copy"
    mesh.write_ply(str(tmp_path / "box $5.ply"))
    copy.mkdir()
    scene = parse(
        r"""<shape type="ply" id="n_\$AssimpFbx\$_R">
        <string name="filename" value="box \$5.ply"/>
        <bsdf type="diffuse" id="a \$ b"/></shape>"""
    )
    again = scenes.parse(scenes.write(scene, copy))
    names = {node.props.id() for node in again.state.nodes}
    assert {"n_$AssimpFbx$_R", "a $ b"} <= names
    assert again.instantiate(merge=False).shapes()


def test_no_two_nodes_of_a_copy_have_one_name(parse, tmp_path):
    scene = parse("".join(f'<shape type="sphere" id="{name}"/>' for name in "abc"))
    for node in scene.state.nodes:
        if node.props.id() == "b":
            node.props.set_id("a")
    (tmp_path / "copy").mkdir()
    written = ElementTree.parse(scenes.write(scene, tmp_path / "copy"))
    assert [node.get("id") for node in written.iter("shape")] == ["a", None, "c"]


def test_a_copy_has_the_names_of_materials(parse, tmp_path):
    """Also of those that one shape has, and that lie in others; a reference needs no second one."""
    scene = parse(
        """<bsdf type="diffuse" id="shared"/>
        <shape type="cube"><bsdf type="twosided" id="oak"><bsdf type="diffuse" id="grain"/></bsdf>
        </shape>
        <shape type="sphere"><ref id="shared"/></shape><shape type="disk"><ref id="shared"/></shape>
        <shape type="rectangle"><bsdf type="diffuse" id="_unnamed_3"/></shape>"""
    )
    (tmp_path / "copy").mkdir()
    path = scenes.write(scene, tmp_path / "copy")
    names = {node.get("id") for node in ElementTree.parse(path).iter("bsdf")}
    assert names == {"shared", "oak", "grain", None}
    assert scenes.parse(path).instantiate(merge=False).shapes()


@pytest.mark.parametrize("name", ["meshes/box.ply", "textures/paint.exr", "light/paint.exr"])
def test_a_missing_file_is_named_with_its_line(name, with_files):
    source = with_files(False)
    (source.parent / name).unlink()
    with pytest.raises(UserError, match=rf"scene.xml \(line \d+.*the file '{name}' does not exist"):
        scenes.parse(source)


def test_a_missing_scene_is_named(tmp_path):
    with pytest.raises(UserError, match=r"none.xml: no such scene file"):
        scenes.parse(tmp_path / "none.xml")


def test_a_scene_that_fails_does_not_disturb_the_next_one(parse):
    """A light without its shape stayed behind, and the next virtual call ended the process."""
    light = '<shape type="rectangle"><emitter type="area"/></shape>'
    kept = []
    for _ in range(2):
        with pytest.raises(UserError, match='Plugin "nothing" not found') as caught:
            parse(light + '<shape type="nothing"/>').instantiate()
        kept.append(caught)
    assert np.isfinite(render(parse(light + BALL.format(DIFFUSE)).instantiate(), 2)).all()


def test_a_mesh_without_triangles_does_not_disturb_the_next_one(parse, tmp_path):
    """It stayed behind in the traceback, and a mesh of the next scene could not be traced."""
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\nf 1//1 2//1\n")
    corners = "v -1 -1 0\nv 1 -1 0\nv 0 1 0\nf 1 2 3\n"
    (tmp_path / "triangle.obj").write_text(corners)
    flat, triangle = (
        f'<shape type="obj"><string name="filename" value="{name}.obj"/>{DIFFUSE}</shape>'
        for name in ("flat", "triangle")
    )
    with pytest.raises(UserError, match="has no triangles") as caught:
        parse(flat + BALL.format(DIFFUSE)).instantiate()
    assert caught.tb is not None  # it lives on, as in a notebook
    assert np.isfinite(render(parse(triangle).instantiate(), 2)).all()


TWO = (
    '<shape type="{}">{}</shape>'
    '<shape type="{}"><transform name="to_world">{}</transform>{}</shape>'
)
PAINT = '<bsdf type="principled"/>'


@pytest.mark.parametrize(
    ("first", "second", "shapes"),
    [("rectangle", "rectangle", 2), ("rectangle", "cube", 2), ("cube", "cube", 1)],
)
def test_shapes_of_one_material_keep_their_extent(first, second, shapes, parse):
    """Mitsuba merges meshes; what it merges with a rectangle has no place in the scene's box."""
    moved = '<translate x="5"/>'
    made = [
        parse(TWO.format(first, PAINT, second, moved, PAINT)).instantiate(merge=merge)
        for merge in (True, False)
    ]
    assert [len(scene.shapes()) for scene in made] == [shapes, 2]
    merged, apart = (np.ravel([scene.bbox().min, scene.bbox().max]) for scene in made)
    np.testing.assert_allclose(merged, apart)
    assert apart[3] == 6


def test_a_room_of_rectangles_keeps_light_out(parse):
    """An environment was seen through the walls: its sphere was that of a box without them."""
    turns = ["", '<rotate y="1" angle="180"/>']
    turns += [f'<rotate {axis}="1" angle="{angle}"/>' for axis in "xy" for angle in (90, -90)]
    walls = "".join(
        f'<shape type="rectangle"><transform name="to_world"><translate z="-1"/>{turn}</transform>'
        '<bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>'
        for turn in turns
    )
    ball = '<shape type="sphere"><float name="radius" value="0.3"/><bsdf type="diffuse"/></shape>'
    scene = parse(walls + ball).instantiate()
    film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
    inside = mi.load_dict(
        {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f().look_at([0, 0, 0.9], [0, 0, 0], [0, 1, 0]),
            "film": film,
        }
    )
    path = mi.load_dict({"type": "path", "max_depth": 4})
    image = mi.render(scene, sensor=inside, integrator=path, spp=16)
    assert float(np.array(image)[..., :3].max()) == 0


def test_curves_have_no_area_that_is_known(tmp_path):
    points = tmp_path / "curve.txt"
    points.write_text("0 0 0 0.1\n0 1 0 0.1\n1 1 0 0.1\n1 2 0 0.1\n")
    curve = mi.load_dict({"type": "bsplinecurve", "filename": str(points)})
    assert surface_area(curve) == 0
    assert surface_area(mi.load_dict({"type": "sphere"})) == pytest.approx(4 * np.pi)


def test_participating_media_are_left_out(parse, tmp_path):
    """With a cut-out they were rendered, and without they were not."""
    fog = '<medium type="homogeneous" name="interior"><float name="sigma_t" value="2"/></medium>'
    cube = f'<shape type="cube"><bsdf type="null"/>{fog}</shape>'
    parsed = parse(cube + BALL.format(DIFFUSE))
    assert parsed.media == 1
    copied = scenes.parse(scenes.write(parsed, tmp_path))
    assert copied.media == 0
    assert not any(shape.is_medium_transition() for shape in copied.instantiate().shapes())


@pytest.mark.parametrize(
    ("shape", "scale", "told"),
    [
        ("sphere", 'x="2"', "the sphere is scaled more along one axis"),
        ("cylinder", 'x="2" y="3"', "the cylinder is scaled more along one axis"),
        ("cylinder", 'x="2" y="2" z="9"', None),
        ("sphere", 'value="-2"', None),
        ("disk", 'x="2"', None),
        ("rectangle", 'z="0"', "the rectangle has no extent along an axis"),
        ("sphere", 'value="1e-7"', None),
    ],
)
def test_shapes_that_mitsuba_makes_otherwise_are_told(shape, scale, told, parse):
    turned = f'<scale {scale}/><rotate y="1" angle="40"/><translate x="100"/>'
    content = (
        f'<shape type="{shape}"><transform name="to_world">{turned}</transform>{PAINT}</shape>'
    )
    if told is None:
        assert parse(content).instantiate().bbox().valid()
        return
    with pytest.raises(UserError, match=rf"scene.xml.*line.*{told}") as caught:
        parse(content)
    assert "\n" not in str(caught.value)


UNUSED = {
    "integrator": '<integrator type="bdpt"><integer name="max_depth" value="3"/></integrator>',
    "stokes": '<integrator type="stokes"><integrator type="path"/></integrator>',
    "film": '<sensor type="perspective"><film type="ldrfilm"><integer name="width" value="24"/>'
    '<integer name="height" value="16"/><string name="fileFormat" value="png"/></film></sensor>',
    "spectral film": '<sensor type="perspective"><film type="specfilm">'
    '<integer name="width" value="24"/><integer name="height" value="16"/></film></sensor>',
    "sampler": '<sensor type="perspective"><sampler type="sobol">'
    '<integer name="scramble" value="5"/></sampler></sensor>',
    "property of an integrator": '<integrator type="path">'
    '<boolean name="strict_normals" value="true"/></integrator>',
    "property of a sampler": '<sensor type="perspective"><sampler type="ldsampler">'
    '<integer name="sampleCount" value="4"/></sampler></sensor>',
    "property of a film": '<sensor type="perspective"><film type="hdrfilm">'
    '<integer name="width" value="24"/><integer name="height" value="16"/>'
    '<float name="gamma" value="2.2"/><rfilter type="gaussian"/></film></sensor>',
}


@pytest.mark.parametrize("kind", UNUSED)
def test_what_nothing_uses_need_not_be_there(kind, parse):
    """Integrators, films and samplers of older versions, and for spectra and polarised light."""
    parsed = parse(BALL.format(DIFFUSE) + UNUSED[kind])
    given = {node.props.plugin_name(): set(node.props) for node in parsed.state.nodes}
    assert not set.union(*given.values()) & {"strict_normals", "sampleCount", "gamma", "scramble"}
    scene = parsed.instantiate()
    if "film" in kind:
        assert list(scene.sensors()[-1].film().size()) == [24, 16]


@pytest.mark.parametrize(
    "inner",
    [
        "",
        '<integer name="max_depth" value="7"/><boolean name="hide_emitters" value="true"/>',
    ],
)
def test_integrators_that_mitsuba_has_stay(inner, parse):
    parsed = parse(BALL.format(DIFFUSE) + f'<integrator type="volpath">{inner}</integrator>')
    (found,) = (n for n in parsed.state.nodes if n.props.plugin_name() == "volpath")
    assert found.props.get("max_depth", 0) == (7 if inner else 0)
    parsed.instantiate()


def test_films_and_samplers_that_mitsuba_has_stay(parse):
    camera = (
        '<sensor type="perspective"><film type="hdrfilm"><integer name="width" value="24"/>'
        '<rfilter type="gaussian"/></film><sampler type="stratified">'
        '<integer name="sample_count" value="16"/></sampler></sensor>'
    )
    nodes = [node.props for node in parse(BALL.format(DIFFUSE) + camera).state.nodes]
    found = {props.plugin_name(): set(props) for props in nodes}
    assert "width" in found["hdrfilm"] and "gaussian" in found
    assert "sample_count" in found["stratified"]


@pytest.mark.parametrize(
    "given",
    [
        '<sensor type="perspective"><sampler type="blendbsdf"/></sensor>',
        '<sensor type="perspective"><film type="bitmap"/></sensor>',
        '<integrator type="ply"><string name="filename" value="../outside.ply"/></integrator>',
    ],
)
def test_what_nothing_uses_is_not_made_where_it_is_of_another_kind(given, parse, monkeypatch):
    monkeypatch.setattr(mi, "load_dict", lambda *_, **__: pytest.fail("it was made"))
    with pytest.raises(UserError):
        parse(BALL.format(DIFFUSE) + given).instantiate()


@pytest.mark.parametrize("name", ["blackbody", "regular", "irregular"])
def test_spectra_without_rgb_are_refused(name, parse):
    light = '<emitter type="point"><spectrum type="{}" name="intensity"/></emitter>'
    with pytest.raises(UserError, match=rf"type '{name}' has no RGB. Give <rgb>"):
        parse(BALL.format(DIFFUSE) + light.format(name))


def test_a_material_that_no_shape_has_is_none_to_fit(parse):
    """BSDFs that stand in a scene, and that nothing refers to."""
    unused = '<bsdf type="principled" id="unused"/>'
    lamp = '<shape type="sphere"><bsdf type="principled"/><emitter type="area"/></shape>'
    glass = '<shape type="cube"><bsdf type="dielectric"/></shape>'
    bare = parse(unused + glass)
    assert material_names(bare) == ["unused"]
    with pytest.raises(UserError, match=r"no material to fit.*Give one a principled BSDF"):
        require_optimized(bare.instantiate(), bare.path)
    furnace = parse(lamp + glass)
    require_optimized(furnace.instantiate(), furnace.path)


def test_spectra_in_parts_that_nothing_uses_do_not_matter(parse):
    bands = '<spectrum type="regular" name="band"/>'
    film = f'<sensor type="perspective"><film type="specfilm">{bands}</film></sensor>'
    parse(BALL.format(DIFFUSE) + film).instantiate()


def test_a_scene_of_rectangles_alone_has_no_shape_that_no_ray_knows(tmp_path):
    """What was merged is empty then; where lamps are hidden, its surface was asked for."""
    path = tmp_path / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><shape type="rectangle" id="floor"><bsdf type="diffuse"/></shape>'
        '<shape type="rectangle" id="lamp"><transform name="to_world"><translate z="1"/>'
        '</transform><emitter type="area"/></shape></scene>'
    )
    scene = scenes.parse(path).instantiate()
    assert len(scene.shapes()) == 2
    ray = mi.Ray3f(mi.Point3f([0, 0.5], 0, 5), mi.Vector3f(0, 0, -1))
    moved = rays_behind_area_emitters(scene, ray)
    np.testing.assert_allclose(np.array(moved.o)[2], 1, atol=1e-3)
