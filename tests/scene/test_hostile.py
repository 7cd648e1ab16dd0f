"""Scenes of strangers: no code of theirs runs, and no file outside of their folder is read."""

import gc
import os
import shutil
import subprocess
import sys
import time
import tracemalloc

import drjit as dr
import mitsuba as mi
import pytest
from scene_texts import BALL, DIFFUSE, PRINCIPLED, ROOM, ROUGHPLASTIC, render

from unbake.errors import UserError
from unbake.scene import edit, preflight
from unbake.scene import parse as scenes


def load(file, root=None):
    parsed = scenes.parse(file, root)
    edit.to_principled(parsed)
    return parsed.instantiate()


@pytest.fixture
def refused(tmp_path):
    """The message with which a scene of this text is refused."""

    def run(text, folder=tmp_path, root=None):
        file = folder / "scene.xml"
        if isinstance(text, bytes):
            file.write_bytes(text)
        else:
            file.write_text(text)
        with pytest.raises(UserError) as caught:
            load(file, root)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    return run


# ------------------------------------------------------------------------------------- native code


@pytest.fixture
def library(tmp_path):
    """A shared library that writes a file the moment it is loaded: its path, and the file's."""
    compiler = shutil.which("cc")
    if compiler is None or sys.platform == "win32":
        pytest.skip("needs a C compiler")
    mark = tmp_path / "loaded"
    source = tmp_path / "evil.c"
    source.write_text(
        "#include <stdio.h>\n__attribute__((constructor)) static void run(void)\n"
        f'{{ FILE *f = fopen("{mark}", "w"); if (f) fclose(f); }}\n'
    )
    suffix = ".dylib" if sys.platform == "darwin" else ".so"
    made = tmp_path / f"evil{suffix}"
    subprocess.run([compiler, "-shared", "-fPIC", "-o", made, source], check=True)
    return made, mark


@pytest.mark.parametrize(
    "text",
    [
        ROOM.format('<shape type="../elsewhere/evil"/>'),
        ROOM.format('<shape type="evil"/>'),
        ROOM.format('<default name="kind" value="../elsewhere/evil"/><shape type="$kind"/>'),
        ROOM.format('<path value="."/><shape type="evil"/>'),
        ROOM.format('<include filename="more.xml"/>'),
        ROOM.format(BALL.format(DIFFUSE)).replace('type="box"', 'type="evil"'),
    ],
    ids=["path", "working folder", "parameter", "search path", "include", "inside"],
)
def test_a_scene_runs_no_code_of_its_own(text, library, refused, tmp_path, monkeypatch):
    made, mark = library
    monkeypatch.chdir(tmp_path)
    for folder in ("plugins", "elsewhere"):
        (tmp_path / folder).mkdir()
        shutil.copy(made, tmp_path / folder)
    (tmp_path / "more.xml").write_text('<scene version="3.0.0"><shape type="evil"/></scene>')
    message = refused(text)
    assert "is no plugin of Mitsuba" in message and ".xml (line " in message
    assert not mark.exists()


def test_an_old_scene_runs_no_code_of_its_own(library, refused, tmp_path, monkeypatch):
    """Scenes of Mitsuba 1 are upgraded first."""
    made, mark = library
    monkeypatch.chdir(tmp_path)
    (tmp_path / "plugins").mkdir()
    shutil.copy(made, tmp_path / "plugins")
    text = ROOM.replace('version="3.0.0"', 'version="0.6.0"').format('<shape type="evil"/>')
    assert "'evil' is no plugin of Mitsuba" in refused(text)
    assert not mark.exists()


def test_the_working_folder_has_no_plugins_of_mitsuba(library, tmp_path):
    """Mitsuba looked there first, for those that it has itself as well."""
    made, mark = library
    (tmp_path / "plugins").mkdir()
    shutil.copy(made, tmp_path / "plugins" / f"independent{made.suffix}")
    code = (
        "from unbake import backend; backend.activate('llvm_ad_rgb'); import mitsuba as mi; "
        "print(mi.load_dict({'type': 'independent'}).class_name())"
    )
    told = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, check=True, capture_output=True, text=True
    )
    assert told.stdout.strip() == "IndependentSampler"
    assert not mark.exists()


# ------------------------------------------------------------------------------------------- files


@pytest.fixture
def mesh(tmp_path):
    """A scene's folder, and a mesh beside it."""
    (tmp_path / "own").mkdir()
    mi.load_dict({"type": "cube"}).write_ply(str(tmp_path / "box.ply"))
    return tmp_path / "own", tmp_path / "box.ply"


def names_file(name):
    shape = f'<shape type="ply"><string name="filename" value="{name}"/>{DIFFUSE}</shape>'
    return ROOM.format(shape)


@pytest.mark.parametrize("way", ["relative", "absolute", "link", "linked folder"])
def test_files_lie_in_the_folder_of_the_scene(way, mesh, refused):
    folder, box = mesh
    (folder / "link.ply").symlink_to(box)
    (folder / "up").symlink_to(folder.parent)
    names = {
        "relative": "../box.ply",
        "absolute": str(box),
        "link": "link.ply",
        "linked folder": "up/box.ply",
    }
    message = refused(names_file(names[way]), folder)
    assert f"'{names[way]}' lies outside the folder {folder}. Move it there, or" in message
    assert "--allow-outside" in message and "scene.xml (line " in message
    # A wider root, such as that of a data set, has it inside.
    assert scenes.parse(folder / "scene.xml", folder.parent).instantiate().shapes()


def test_a_uri_is_no_file(mesh, refused):
    folder, box = mesh
    assert "does not exist" in refused(names_file(f"file://{box}"), folder)


@pytest.mark.parametrize(
    "element",
    [
        '<include filename="../secret.xml"/>',
        '<default name="up" value=".."/><include filename="$up/secret.xml"/>',
        '<path value=".."/>',
        '<emitter type="point"><spectrum name="intensity" filename="../secret.xml"/></emitter>',
    ],
)
def test_what_mitsuba_reads_while_it_parses_lies_inside(element, mesh, refused):
    folder, _ = mesh
    (folder.parent / "secret.xml").write_text('<scene version="3.0.0"/>')
    assert "lies outside the folder" in refused(ROOM.format(element), folder)


def test_a_pipe_is_not_read(mesh, refused):
    folder, _ = mesh
    os.mkfifo(folder / "pipe.ply")
    started = time.perf_counter()
    assert "'pipe.ply' is no regular file" in refused(names_file("pipe.ply"), folder)
    assert "'pipe.ply' is no regular file" in refused(
        ROOM.format('<include filename="pipe.ply"/>'), folder
    )
    assert time.perf_counter() - started < 5


def test_includes_and_search_paths_work(mesh, tmp_path):
    folder, box = mesh
    (folder / "parts").mkdir()
    shutil.move(box, folder / "parts" / "box.ply")
    shape = f'<shape type="ply"><string name="filename" value="box.ply"/>{DIFFUSE}</shape>'
    (folder / "parts" / "more.xml").write_text(f'<scene version="3.0.0">{shape}</scene>')
    scene = folder / "scene.xml"
    for text in (
        '<include filename="parts/more.xml"/>',
        '<path value="parts"/><include filename="more.xml"/>',
        f'<path value="parts"/>{shape}',
        '<default name="in" value="parts"/><include filename="$in/more.xml"/>',
    ):
        scene.write_text(ROOM.format(text))
        assert len(scenes.parse(scene).instantiate().shapes()) == 1


def test_a_copy_takes_nothing_but_named_files(mesh, tmp_path, monkeypatch):
    """Any text that was the name of a file in the working folder was taken for a file."""
    folder, _ = mesh
    monkeypatch.chdir(folder.parent)
    (folder.parent / "luminance").write_text("secret")
    text = '<string name="pixel_format" value="luminance"/><string name="{}" value="{}"/>'
    wanted = ROOM.format(BALL.format(DIFFUSE)).replace(
        "<rfilter", text.format("file_format", "openexr") + "<rfilter"
    )
    (folder / "scene.xml").write_text(wanted)
    (tmp_path / "copy").mkdir()
    path = scenes.write(scenes.parse(folder / "scene.xml"), tmp_path / "copy")
    assert [p.name for p in path.parent.iterdir()] == ["scene.xml"]
    assert 'value="luminance"' in path.read_text()


# --------------------------------------------------------------------------------------------- XML


def nested(count, kind="twosided"):
    inner = f'<bsdf type="{kind}">' * count + DIFFUSE + "</bsdf>" * count
    return ROOM.format(BALL.format(inner))


def chain(count):
    """BSDFs that refer to each other, side by side in the file."""
    first = DIFFUSE.replace("<bsdf", '<bsdf id="b0"')
    links = (
        f'<bsdf type="twosided" id="b{i}"><ref id="b{i - 1}"/></bsdf>' for i in range(1, count)
    )
    return ROOM.format(first + "".join(links) + BALL.format(f'<ref id="b{count - 1}"/>'))


def doubled(count):
    """Parameters that each hold the one before twice."""
    twice = (f'<default name="p{i}" value="$p{i - 1}$p{i - 1}"/>' for i in range(1, count))
    return ROOM.format('<default name="p0" value="0123456789"/>' + "".join(twice))


HOSTILE = {
    "another root": ("<bsdf version='3.0.0' type='diffuse'/>", "its root is <bsdf>, not <scene>"),
    "Latin 1": (ROOM.format("<!-- é -->").encode("latin-1"), "is not UTF-8. Save it as UTF-8"),
    "declared": (
        '<?xml version="1.0" encoding="latin-1"?>' + ROOM.format(""),
        "the encoding is 'latin-1'. Save it as UTF-8",
    ),
    "UTF-16": (ROOM.format("").encode("utf-16"), "is not UTF-8. Save it as UTF-8"),
    "zero byte": (ROOM.format("\0"), "it has a zero byte"),
    "entities": (
        '<!DOCTYPE scene [<!ENTITY a SYSTEM "/etc/hostname">]>' + ROOM.format("&a;"),
        "a scene has no document type or entities. Remove <!DOCTYPE",
    ),
    "200,000 levels": (nested(200_000), "elements are nested more than 20 deep"),
    "25 levels": (nested(25), "elements are nested more than 20 deep"),
    "a chain": (chain(20_000), "elements are nested more than 20 deep"),
    "a circle": (
        ROOM.format(
            '<bsdf type="twosided" id="a"><ref id="b"/></bsdf>'
            '<bsdf type="twosided" id="b"><ref id="a"/></bsdf>'
        ),
        "elements refer to each other in a circle",
    ),
    "an alias of itself": (ROOM.format('<alias id="a" as="a"/><ref id="a"/>'), '"a" not found'),
    "a circle of includes": (
        ROOM.format('<include filename="scene.xml"/>'),
        "files include each other",
    ),
    "many elements": (ROOM.format("<ref/>" * 200_000), "more than 200000 elements"),
    "many parameters": (
        ROOM.format("".join(f'<default name="p{i}" value="1"/>' for i in range(300))),
        "more than 256 parameters",
    ),
    "doubled parameters": (doubled(40), "a value has more than 65536 characters"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_xml_that_no_scene_has(case, refused):
    text, message = HOSTILE[case]
    started = time.process_time()
    assert message in refused(text)
    assert time.process_time() - started < 10


def test_elements_of_includes_count(refused, tmp_path):
    many = '<include filename="refs.xml"/>' * 40
    (tmp_path / "more.xml").write_text(f'<scene version="3.0.0">{many}</scene>')
    (tmp_path / "refs.xml").write_text(f'<scene version="3.0.0">{"<ref/>" * 6000}</scene>')
    assert "more than 200000 elements" in refused(ROOM.format('<include filename="more.xml"/>'))


def test_large_scenes_are_capped(refused, monkeypatch):
    monkeypatch.setattr(preflight, "BYTES", 1 << 20)
    assert "has more than 1 MiB of XML" in refused(ROOM.format(" " * (1 << 20)))


def test_a_scene_of_one_point_is_refused(refused, tmp_path):
    flat = '<transform name="to_world"><scale value="0"/></transform>'
    told = refused(ROOM.format(f'<shape type="cube">{flat}<bsdf type="diffuse"/></shape>'))
    assert "the cube has no extent along an axis" in told
    (tmp_path / "dot.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    file = '<string name="filename" value="dot.obj"/>'
    told = refused(ROOM.format(f'<shape type="obj">{file}{flat}<bsdf type="diffuse"/></shape>'))
    assert "all shapes of the scene lie in one point" in told


def test_a_small_scene_is_read_in_little_memory(tmp_path):
    file = tmp_path / "scene.xml"
    file.write_text(ROOM.format(""))
    gc.collect()
    dr.sync_thread()  # a thread of Dr.Jit that begins while memory is traced crashes Python 3.11
    tracemalloc.start()
    preflight.check_xml(file, tmp_path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 1 << 20


def test_ten_levels_are_fine(tmp_path):
    (tmp_path / "scene.xml").write_text(nested(10, "mask"))
    assert scenes.parse(tmp_path / "scene.xml").instantiate().shapes()


# -------------------------------------------------------------------------------------- properties


MISSPELT = {
    "light": (
        BALL.format(DIFFUSE + '<emitter type="area"><rgb name="radience" value="13"/></emitter>'),
        "radience",
    ),
    "shape": ('<shape type="sphere"><float name="radiuss" value="2"/></shape>', "radiuss"),
    "principled": (BALL.format(PRINCIPLED.replace("roughness", "roughnes")), "roughnes"),
    "diffuse": (BALL.format(DIFFUSE.replace("reflectance", "reflectence")), "reflectence"),
    "roughplastic": (BALL.format(ROUGHPLASTIC.replace("int_ior", "ior")), "ior"),
    "film": (
        BALL.format(DIFFUSE)
        + '<sensor type="perspective"><film type="hdrfilm"><integer name="widht" value="3"/>'
        "</film></sensor>",
        "widht",
    ),
}


@pytest.mark.parametrize("case", MISSPELT)
def test_misspelt_properties_are_refused(case, refused):
    """Reading properties had marked all of them as known to Mitsuba."""
    content, name = MISSPELT[case]
    message = refused(ROOM.format(content))
    assert name in message and "scene.xml (line " in message


@pytest.mark.parametrize(
    ("name", "value"), [("roughness", -5), ("roughness", 1.5), ("metallic", 7)]
)
def test_numbers_of_no_surface_are_refused(name, value, refused):
    """A capture wrote a truth of -5, and a fit of the albedo alone rendered with it."""
    bsdf = f'<bsdf type="principled"><float name="{name}" value="{value}"/></bsdf>'
    message = refused(ROOM.format(BALL.format(bsdf)))
    assert f"'{name}' of principled is {value}, not from 0 to 1. Correct it" in message


def test_all_misspelt_properties_of_an_element_are_told(refused):
    unknown = '<float name="one" value="2"/><float name="two" value="2"/>'
    message = refused(ROOM.format(BALL.format(unknown)))
    assert '"one"' in message and '"two"' in message


@pytest.mark.parametrize(
    ("alpha", "told"),
    [
        ('<texture name="alpha" type="checkerboard"/>', "is a texture"),
        ('<float name="alpha" value="-0.1"/>', "is -0.1"),
        ('<string name="alpha" value="smooth"/>', "is 'smooth'"),
    ],
)
def test_rough_plastic_has_one_width(alpha, told, refused):
    number = '<float name="alpha" value="0.04"/>'
    message = refused(ROOM.format(BALL.format(ROUGHPLASTIC.replace(number, alpha))))
    assert f"'alpha' of roughplastic {told}, not a number from 0. Use a principled" in message
    assert "scene.xml (line " in message


def test_meshes_with_flipped_normals_stand_beside_others(parse):
    """Mitsuba would merge them, and cannot: "Mesh::merge(): the two meshes are incompatible"."""
    flip = '<boolean name="flip_normals" value="true"/>'
    cube = '<shape type="cube">{}<ref id="paint"/></shape>'
    paint = DIFFUSE.replace("<bsdf", '<bsdf id="paint"')
    content = paint + cube.format("") * 2 + cube.format(flip) * 2 + BALL.format('<ref id="paint"/>')
    scene = parse(content).instantiate()
    assert sorted(shape.class_name() for shape in scene.shapes()) == ["Mesh", "Mesh", "Sphere"]
    assert render(scene, 2).mean() > 0.05
    flipped = cube.format(flip) * 2
    assert len(parse(paint + flipped).instantiate().shapes()) == 1
