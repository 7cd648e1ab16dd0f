"""Bad input: one clear line, exit status 2, and nothing half-written."""

import json
import shutil

import mitsuba as mi
import numpy as np
import pytest

from unbake.imaging.pictures import read_exr, write_exr


@pytest.fixture
def data(cornell, tmp_path):
    """A data set of one's own, to break."""
    return shutil.copytree(cornell, tmp_path / "data")


@pytest.fixture
def refuses(unbake, tmp_path):
    """Run a command that must fail; returns its one line."""

    def run(*words, leaves=()):
        before = {p for p in tmp_path.rglob("*")} | {tmp_path / name for name in leaves}
        outcome = unbake(*words)
        assert outcome.status == 2, outcome
        lines = outcome.err.splitlines()
        assert len(lines) == 1 and lines[0].startswith("error: "), outcome.err
        assert "Traceback" not in outcome.err
        assert {p for p in tmp_path.rglob("*")} <= before
        return lines[0]

    return run


@pytest.fixture
def refused_fit(refuses, tmp_path, tiny):
    def run(data, *words):
        return refuses("fit", data, "--out", tmp_path / "run", "--settings", tiny, *words)

    return run


def edit_frames(data, edit):
    file = data / "transforms.json"
    content = json.loads(file.read_text())
    edit(content)
    file.write_text(json.dumps(content))


def spoil(path, value, count=3):
    pixels = read_exr(path)
    pixels[0, :count, 1] = value
    write_exr(path, pixels)


# ------------------------------------------------------------------------------------------ data


def test_no_data_folder(refused_fit, tmp_path):
    line = refused_fit(tmp_path / "nothing")
    assert "nothing: the data folder does not exist. Check the path" in line


def test_a_scene_file_in_place_of_a_data_folder(refused_fit, data):
    line = refused_fit(data / "scene" / "scene.xml")
    assert "scene.xml: is a file, not a data folder" in line
    assert "unbake capture SCENE --out DATA" in line


def test_a_folder_without_cameras(refused_fit, data):
    (data / "transforms.json").unlink()
    assert "no transforms.json in the folder" in refused_fit(data)


def test_cameras_that_are_no_json(refused_fit, data):
    (data / "transforms.json").write_text('{"frames": [')
    assert "transforms.json: the file is not readable JSON" in refused_fit(data)


def test_no_views(refused_fit, data):
    edit_frames(data, lambda content: content.update(frames=[]))
    assert "transforms.json: 'frames' is not a list of frames" in refused_fit(data)


def test_no_training_view(refused_fit, data):
    def all_held_out(content):
        for frame in content["frames"]:
            frame["split"] = "heldout"

    edit_frames(data, all_held_out)
    assert "no view has the split 'train'" in refused_fit(data)


@pytest.mark.parametrize("length", [0, 3, 100, 0.5, -1])
def test_a_truncated_image(length, refused_fit, data):
    image = data / "images" / "train_001.exr"
    whole = image.read_bytes()
    image.write_bytes(whole[: int(length * len(whole)) if length == 0.5 else length])
    assert "images/train_001.exr: the image cannot be read" in refused_fit(data)


def test_an_image_that_is_something_else(refused_fit, data):
    (data / "images" / "train_001.exr").write_text("<html>404</html>")
    assert "train_001.exr: the image cannot be read (it is not OpenEXR)" in refused_fit(data)


@pytest.mark.parametrize(
    "name", ["images/train_001", "images/heldout_000", "truth/albedo/train_000"]
)
def test_an_image_of_another_size(name, refused_fit, data):
    write_exr(data / f"{name}.exr", np.ones((8, 16, 4)))
    line = refused_fit(data)
    assert f"{name}.exr: the image has 16 x 8 pixels, its frame says 16 x 16" in line


def test_a_missing_image(refused_fit, data):
    (data / "images" / "heldout_000.exr").unlink()
    assert "images/heldout_000.exr: the image does not exist" in refused_fit(data)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_pixels_that_are_not_finite(value, refused_fit, data):
    spoil(data / "images" / "train_000.exr", value)
    line = refused_fit(data, "--clip-negative")
    assert "images/train_000.exr: 3 of 256 pixels are NaN or infinite" in line


def test_negative_pixels_and_how_to_accept_them(refused_fit, unbake, data, tiny, tmp_path):
    spoil(data / "images" / "train_000.exr", -0.5)
    line = refused_fit(data)
    assert "images/train_000.exr: 3 of 256 pixels are negative" in line
    assert "--clip-negative" in line
    words = ("--settings", tiny, "--method", "direct", "--steps", 1, "--clip-negative")
    assert unbake("fit", data, "--out", tmp_path / "run", *words).status == 0
    # A run that was started with it goes on and evaluates with it
    assert unbake("fit", data, "--out", tmp_path / "run", "--resume", "--steps", 2).status == 0
    words = ("--spp", 1, "--max-depth", 2, "--train-views", 1)
    assert unbake("evaluate", tmp_path / "run", *words).status == 0


def test_a_spoilt_held_out_view_is_found_when_it_is_used(unbake, refuses, data, tiny, tmp_path):
    spoil(data / "images" / "heldout_000.exr", -0.5)
    run = tmp_path / "run"
    words = ("--settings", tiny, "--method", "direct", "--steps", 1)
    assert unbake("fit", data, "--out", run, *words).status == 0
    words = ("--spp", 1, "--max-depth", 2, "--train-views", 0)
    made = ["run/evaluation", "run/evaluation/.lock"]
    line = refuses("evaluate", run, *words, leaves=made)
    assert "images/heldout_000.exr: 3 of 256 pixels are negative" in line
    assert unbake("evaluate", run, *words, "--clip-negative").status == 0


def test_an_evaluation_without_views(unbake, refuses, data, tiny, tmp_path):
    run = tmp_path / "run"
    edit_frames(data, lambda d: d.update(frames=[f for f in d["frames"] if f["split"] == "train"]))
    words = ("--settings", tiny, "--method", "direct", "--steps", 1)
    assert unbake("fit", data, "--out", run, *words).status == 0
    line = refuses("evaluate", run, "--spp", 1, "--train-views", 0)
    assert "--train-views: no view to evaluate" in line
    assert unbake("evaluate", run, "--spp", 1, "--train-views", 1).status == 0


def test_black_photographs(refused_fit, data):
    for name in ("train_000", "train_001"):
        pixels = read_exr(data / "images" / f"{name}.exr")
        pixels[..., :3] = 0
        write_exr(data / "images" / f"{name}.exr", pixels)
    assert "all training images are black" in refused_fit(data)


def test_a_damaged_truth_image_is_found_before_the_fit(refused_fit, data):
    path = data / "truth" / "albedo" / "heldout_000.exr"
    path.write_bytes(path.read_bytes()[:-9])
    assert "truth/albedo/heldout_000.exr: the image cannot be read" in refused_fit(data)


def test_every_image_of_a_fit_is_read_once(unbake, data, tiny, tmp_path, monkeypatch):
    read = []
    plain = mi.Bitmap

    def counting(first, *words, **named):
        if isinstance(first, str):
            read.append(first)
        return plain(first, *words, **named)

    counting.PixelFormat, counting.FileFormat = plain.PixelFormat, plain.FileFormat
    monkeypatch.setattr(mi, "Bitmap", counting)
    words = ("--settings", tiny, "--method", "direct", "--steps", 2)
    assert unbake("fit", data, "--out", tmp_path / "run", *words).status == 0
    names = sorted(name.split("/data/")[1] for name in read)
    assert names == [
        "images/train_000.exr",
        "images/train_001.exr",
        "truth/albedo/heldout_000.exr",
        "truth/roughness/heldout_000.exr",
    ]


def test_a_camera_inside_geometry_is_a_warning(unbake, data, tiny, tmp_path):
    mesh = mi.load_dict({"type": "ply", "filename": str(data / "scene/meshes/tall.ply")})
    middle = np.ravel(mesh.bbox().center()).tolist()

    def move(content):
        for row, value in zip(content["frames"][0]["transform_matrix"], middle, strict=False):
            row[3] = value

    edit_frames(data, move)
    words = ("--settings", tiny, "--method", "direct", "--steps", 1)
    outcome = unbake("fit", data, "--out", tmp_path / "run", *words)
    assert outcome.status == 0
    assert "warning: train_000: the camera seems to stand inside geometry" in outcome.out


# ----------------------------------------------------------------------------------------- scene


LIGHT = (
    '<shape type="rectangle"><emitter type="area"><rgb name="radiance" value="1"/></emitter>'
    "</shape>"
)
BALL = '<shape type="sphere">{inside}<bsdf type="diffuse"/></shape>'


def scene(content, version="3.0.0"):
    return f'<scene version="{version}">{content}</scene>'


BAD_SCENES = {
    "no light": (scene(BALL.format(inside="")), "the scene has no light source"),
    "only glass": (
        scene(LIGHT + '<shape type="sphere"><bsdf type="dielectric"/></shape>'),
        "no material to fit",
    ),
    "no shapes": (
        scene('<emitter type="constant"/><bsdf type="diffuse" id="a"/>'),
        "the scene has no shapes, or one without end",
    ),
    "cut off": ('<scene version="3.0.0"><shape', "not a scene that Mitsuba can read"),
    "empty": ("", "not a scene that Mitsuba can read"),
    "web page": ("<html/>", "not a scene that Mitsuba can read"),
    "unknown plugin": (
        scene(LIGHT + '<shape type="spere"><bsdf type="diffuse"/></shape>'),
        'Plugin "spere" not found',
    ),
    "endless plugin": (
        scene(LIGHT + f'<shape type="{"x" * 5000}"><bsdf type="diffuse"/></shape>'),
        "x' is no plugin of Mitsuba",
    ),
    "unknown reference": (scene(LIGHT + BALL.format(inside='<ref id="x"/>')), 'reference to "x"'),
    "missing mesh": (
        scene(
            LIGHT + '<shape type="ply"><string name="filename" value="gone.ply"/>'
            '<bsdf type="diffuse"/></shape>'
        ),
        "(line 1, col 120): the file 'gone.ply' does not exist",
    ),
    "bitmap without a file": (
        scene(
            LIGHT + '<shape type="sphere"><bsdf type="diffuse"><texture type="bitmap" '
            'name="reflectance"><string name="file" value="a.exr"/></texture></bsdf></shape>'
        ),
        "the bitmap has no 'filename'. Add it",
    ),
    "blend of nothing": (
        scene(LIGHT + '<shape type="sphere"><bsdf type="blendbsdf"/></shape>'),
        "the blendbsdf has no 'weight'. Add it",
    ),
    "no number": (
        scene(LIGHT + BALL.format(inside='<float name="radius" value="wide"/>')),
        'could not parse floating point value "wide"',
    ),
    "radius": (
        scene(LIGHT + BALL.format(inside='<float name="radius" value="nan"/>')),
        "sphere.radius has a number that is not finite",
    ),
    "point": (
        scene(LIGHT + BALL.format(inside='<point name="center" x="inf" y="0" z="0"/>')),
        "sphere.center has a number that is not finite",
    ),
    "transform": (
        scene(
            LIGHT
            + BALL.format(
                inside='<transform name="to_world"><translate x="nan"/></transform>',
            )
        ),
        "sphere.to_world has a number that is not finite",
    ),
    "colour": (
        scene(LIGHT.replace('value="1"', 'value="nan 1 1"') + BALL.format(inside="")),
        "area.radiance has a number that is not finite",
    ),
    "spectrum": (
        scene(
            '<emitter type="point"><spectrum name="intensity" value="400:nan, 700:1"/></emitter>'
            + BALL.format(inside="")
        ),
        "point.intensity has a number that is not finite",
    ),
}


@pytest.mark.parametrize("case", BAD_SCENES)
def test_a_scene_that_cannot_be_captured(case, refuses, tmp_path):
    text, message = BAD_SCENES[case]
    file = tmp_path / "bad.xml"
    file.write_text(text)
    line = refuses("capture", file, "--out", tmp_path / "data")
    assert message in line and "bad.xml" in line


@pytest.mark.parametrize("case", ["no light", "only glass", "cut off", "unknown plugin", "radius"])
def test_a_scene_that_cannot_be_fitted(case, refused_fit, data):
    text, message = BAD_SCENES[case]
    (data / "scene" / "scene.xml").write_text(text)
    line = refused_fit(data)
    assert message in line and "scene/scene.xml" in line


def test_a_binary_file_is_no_scene(refuses, tmp_path):
    (tmp_path / "bad.xml").write_bytes(bytes(range(256)))
    line = refuses("capture", tmp_path / "bad.xml", "--out", tmp_path / "data")
    assert "not a scene that Mitsuba can read" in line


def test_a_damaged_mesh(refused_fit, data):
    (data / "scene" / "meshes" / "tall.ply").write_bytes(b"ply\nformat")
    line = refused_fit(data)
    assert "tall.ply: not a PLY file: its header is not readable" in line


def test_a_mesh_of_vertices_that_it_does_not_have(data, refuses, tmp_path, tiny):
    """Mitsuba read beyond its vertices: capturing ended by a signal, fitting went on."""
    mesh = data / "scene" / "meshes" / "tall.ply"
    content = bytearray(mesh.read_bytes())
    content[-4:] = (4_000_000).to_bytes(4, "little")
    mesh.write_bytes(content)
    for words in (
        ("capture", data / "scene" / "scene.xml", "--out", tmp_path / "again"),
        ("fit", data, "--out", tmp_path / "run", "--settings", tiny),
    ):
        line = refuses(*words)
        assert "tall.ply: 1 of 10 triangles are of vertices that do not exist" in line


def test_files_of_a_scene_lie_in_the_data_set_unless_allowed(data, refuses, unbake, tiny, tmp_path):
    """A link into another folder is followed only with --allow-outside, by each command."""
    mesh, run = data / "scene" / "meshes" / "tall.ply", tmp_path / "run"
    mesh.rename(data / "tall.ply")
    mesh.symlink_to(data / "tall.ply")  # inside of the data set, outside of its scene's folder
    fit = ("fit", data, "--out", run, "--settings", tiny, "--steps", "1")
    assert unbake(*fit).status == 0
    shutil.rmtree(run)
    (data / "tall.ply").rename(tmp_path / "tall.ply")
    (data / "tall.ply").symlink_to(tmp_path / "tall.ply")
    told = "'meshes/tall.ply' lies outside the folder"
    assert told in refuses(*fit, leaves=["data/.cache"])
    assert unbake(*fit, "--allow-outside").status == 0
    evaluate = ("evaluate", run, "--spp", "1", "--train-views", "0")
    assert told in refuses(*evaluate)
    assert unbake(*evaluate, "--allow-outside").status == 0
    capture = ("capture", data / "scene" / "scene.xml", "--out", tmp_path / "again")
    assert told in refuses(*capture)
    small = ("--views", "1", "--held-out", "0", "--resolution", "8", "--spp", "1")
    assert unbake(*capture, *small, "--allow-outside").status == 0
    assert not (tmp_path / "again" / "scene" / "meshes" / "tall.ply").is_symlink()


@pytest.mark.parametrize(
    "shapes",
    [
        '<shape type="obj" id="flat"><string name="filename" value="mesh.obj"/>{}</shape>',
        '<shape type="shapegroup" id="all"><shape type="obj" id="flat"><string name="filename" '
        'value="mesh.obj"/>{}</shape></shape><shape type="instance"><ref id="all"/></shape>',
    ],
    ids=["alone", "in a group"],
)
def test_a_mesh_whose_faces_are_no_triangles(shapes, refuses, tmp_path):
    (tmp_path / "mesh.obj").write_text("v 0 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\nf 1//1 2//1\n")
    material = '<bsdf type="diffuse" id="grey"/>'
    file = tmp_path / "bad.xml"
    file.write_text(scene(LIGHT + BALL.format(inside="") + shapes.format(material)))
    line = refuses("capture", file, "--out", tmp_path / "data")
    assert "bad.xml: the mesh" in line and "has no triangles. Remove it" in line


def test_an_unknown_scene(refuses, tmp_path):
    line = refuses("capture", "dmeo", "--out", tmp_path / "data")
    assert "no such scene: 'dmeo'. Give an XML file or one of demo, annex, still, cornell" in line


def test_a_missing_scene_file(refuses, tmp_path):
    line = refuses("capture", tmp_path / "none.xml", "--out", tmp_path / "data")
    assert "none.xml: no such scene file" in line


def test_what_exists_is_not_written_over(refuses, data):
    line = refuses("capture", "cube", "--out", data)
    assert "data: exists already. Give another --out, or remove it" in line


# --------------------------------------------------------------------------------------- cameras


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is not readable JSON"),
        ("[]", "no cameras in the file"),
        ('{"cameras": []}', "no cameras in the file"),
        ('{"cameras": [3]}', "camera 0: the entry is not an object"),
        ('[{"origin": [0, 0, 1], "target": [0, 0, 0], "up": [0, 1, 0]}]', "'fov' is missing"),
        (
            '[{"origin": [0, 0, 1], "target": [0, 0, 1], "up": [0, 1, 0], "fov": 40}]',
            "origin, target and up do not define a view",
        ),
        (
            '[{"origin": [0, 0, NaN], "target": [0, 0, 1], "up": [0, 1, 0], "fov": 40}]',
            "origin, target and up do not define a view",
        ),
        (
            '[{"origin": [0, 0, 9], "target": [0, 0, 0], "up": [0, 1, 0], "fov": 40, '
            '"split": "heldout"}]',
            "no training view",
        ),
    ],
)
def test_a_broken_camera_file(text, message, refuses, tmp_path):
    (tmp_path / "cameras.json").write_text(text)
    words = ("--cameras", tmp_path / "cameras.json", "--resolution", 4, "--spp", 1)
    line = refuses("capture", "cube", "--out", tmp_path / "data", *words)
    assert message in line and "cameras.json" in line


def test_a_missing_camera_file(refuses, tmp_path):
    words = ("--cameras", tmp_path / "none.json")
    line = refuses("capture", "cube", "--out", tmp_path / "data", *words)
    assert "none.json: the file does not exist" in line


# ---------------------------------------------------------------------------- settings and runs


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"stepz = 3", "stepz: unknown key"),
        (b'steps = "many"', "steps: must be int, not str"),
        (b"spp = 3", "spp: must be an even number, 2 or more, not 3"),
        (b"steps = \xff", "is not UTF-8 text"),
        (b"steps = ", "not valid TOML"),
    ],
)
def test_a_broken_settings_file(content, message, refuses, cornell, tmp_path):
    (tmp_path / "a.toml").write_bytes(content)
    words = ("--out", tmp_path / "run", "--settings", tmp_path / "a.toml")
    line = refuses("fit", cornell, *words)
    assert "a.toml" in line and message in line


@pytest.mark.parametrize("place", ["file", "file/run"])
def test_a_run_cannot_be_written_into_a_file(place, refuses, cornell, tiny, tmp_path):
    (tmp_path / "file").write_text("mine")
    words = ("--settings", tiny, "--method", "direct", "--steps", 1)
    line = refuses("fit", cornell, "--out", tmp_path / place, *words)
    assert "file" in line and ("Not a directory" in line or "File exists" in line)
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize("place", ["file/data", "file"])
def test_a_data_set_cannot_be_written_into_a_file(place, refuses, tmp_path):
    (tmp_path / "file").write_text("mine")
    line = refuses("capture", "cube", "--out", tmp_path / place)
    assert f"{place}: " in line and ("Not a directory" in line or "exists already" in line)


def test_a_folder_that_is_no_run(refuses, cornell, tmp_path):
    assert "no run in this folder" in refuses("evaluate", tmp_path)
    assert "no run in this folder" in refuses("evaluate", tmp_path / "none")
    line = refuses("report", tmp_path, "--out", tmp_path / "report.html")
    assert "unbake evaluate" in line
    assert "no run given" in refuses("report", "--out", tmp_path / "report.html")


def test_a_run_whose_data_are_gone(unbake, refuses, data, tiny, tmp_path):
    run = tmp_path / "run"
    words = ("--settings", tiny, "--method", "direct")
    assert unbake("fit", data, "--out", run, *words, "--steps", 1).status == 0
    moved = data.rename(tmp_path / "moved")
    line = refuses("evaluate", run)
    assert "data: the data set of the run" in line and "--resume" in line
    # What the line says helps
    assert unbake("fit", moved, "--out", run, "--resume").status == 0
    assert unbake("evaluate", run, "--spp", 1, "--train-views", 0).status == 0
