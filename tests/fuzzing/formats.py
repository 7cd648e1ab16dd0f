"""The table of formats: for each file that unbake reads, examples, mutations, and what reads it.

A new format is one entry of `FORMATS`. Readers are called as commands are: an error that the
command line tells in one line is good, and so is a file that is read.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from unittest.mock import patch

from . import mutations
from .mutations import Mutation

ROOT = Path(__file__).parents[2]
#: A data set and a run that version 0.1 wrote.
FIRST = ROOT / "tests" / "data" / "version-0.1"


@dataclass(frozen=True)
class Format:
    """A kind of file.

    Args:
        file: where the damaged file lies in the folder that is read.
        samples: whole files, which are damaged.
        mutations: how; what is named twice is twice as likely.
        read: reads the folder, as a command does.
        prepare: fills the folder with the files around the damaged one.
        weight: how many inputs it gets, compared to others.
        makes: files that `read` may make when it succeeds.
    """

    file: str
    samples: Callable[[], Sequence[bytes]]
    mutations: tuple[Mutation, ...]
    read: Callable[[Path], object]
    prepare: Callable[[Path], object] = lambda folder: None
    weight: float = 1.0
    makes: tuple[str, ...] = ()


def _files(*names: str) -> Callable[[], Sequence[bytes]]:
    """Files of the first version as samples."""
    return lambda: [(FIRST / name).read_bytes() for name in names]


def _texts(*texts: str) -> Callable[[], Sequence[bytes]]:
    return lambda: [text.encode() for text in texts]


# --------------------------------------------------------------------------------------- data sets


def _data_set(folder: Path) -> None:
    shutil.copytree(FIRST / "data", folder, dirs_exist_ok=True)


def _data_set_with(suffix: str) -> Callable[[Path], None]:
    """A data set one of whose photographs is a file of another kind."""

    def prepare(folder: Path) -> None:
        _data_set(folder)
        file = folder / "transforms.json"
        file.write_text(file.read_text().replace("train_001.exr", f"train_001.{suffix}"))

    return prepare


def _coded_data_set(suffix: str) -> Callable[[Path], None]:
    """A data set one of whose photographs holds code values."""

    def prepare(folder: Path) -> None:
        _data_set(folder)
        file = folder / "transforms.json"
        content = json.loads(file.read_text())
        for frame in content["frames"]:
            if frame["file_path"].endswith("train_001.exr"):
                frame |= {"file_path": f"images/train_001.{suffix}", "encoding": "srgb"}
        file.write_text(json.dumps(content))

    return prepare


def _coded(suffix: str) -> Callable[[], Sequence[bytes]]:
    """Photographs of 16 x 16 code values: of 8 bits, and of 16 where PNG has them."""

    def make() -> Sequence[bytes]:
        from io import BytesIO

        import mitsuba as mi
        import numpy as np
        from PIL import Image

        codes = np.random.default_rng(0).integers(0, 256, (16, 16, 3)).astype(np.uint8)
        stream = BytesIO()
        Image.fromarray(codes).save(stream, {"jpg": "JPEG", "tif": "TIFF", "png": "PNG"}[suffix])
        found = [stream.getvalue()]
        if suffix == "png":
            fine = mi.MemoryStream()
            mi.Bitmap(codes.astype(np.uint16) * 257).write(fine, mi.Bitmap.FileFormat.PNG)
            found.append(fine.raw_buffer())
        return found

    return make


def _read_foreign(folder: Path) -> None:
    from unbake.importing.faults import Faults
    from unbake.importing.frames import read_one_file
    from unbake.importing.source import Reading

    faults = Faults()
    read_one_file(folder / "transforms.json", Reading(), faults)
    faults.require_none(folder)


def _nerfstudio() -> Sequence[bytes]:
    content = json.loads((FIRST / "data" / "transforms.json").read_text())
    del content["scene"]
    content |= {"applied_transform": [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]}
    content |= {"camera_model": "OPENCV", "k1": 0.1, "test_filenames": ["images/heldout_000.exr"]}
    return [json.dumps(content).encode()]


def _told_data_sets() -> Sequence[bytes]:
    """A data set of the first version, and one that tells what photographs are."""
    (first,) = _files("data/transforms.json")()
    told = json.loads(first)
    told |= {"noise": {"shot": 0.001, "read": 0.002}, "clipped": 4.0}
    told["frames"][0] |= {"exposure": 2.0, "noise": {"shot": 0.002}, "clipped": None}
    return [first, json.dumps(told).encode()]


def _load_data(folder: Path) -> None:
    from unbake.dataset.views import Dataset

    Dataset.load(folder)


def _read_cameras(folder: Path) -> None:
    from unbake.dataset.camera_files import read_cameras

    read_cameras(folder / "cameras.json", 8, 8)


def _load_photographs(folder: Path) -> None:
    from unbake.dataset.views import Dataset
    from unbake.training.problem import training_pixels

    training_pixels(Dataset.load(folder), clip_negative=True)


def _read_picture(folder: Path) -> None:
    from unbake.imaging.pictures import read_exr

    read_exr(folder / "picture.exr")


def _read_degraded(folder: Path) -> None:
    from unbake.dataset.views import Dataset
    from unbake.evaluation.evaluate import require_true_materials

    require_true_materials(Dataset.load(folder))


def _read_emission(folder: Path) -> None:
    from unbake.dataset.lighting import true_emission

    true_emission(folder)


DEGRADED = json.dumps({"gain": 0.5, "displaced": {"meshes": [], "world_units": 0.0}})
CAMERAS = json.dumps(
    {
        "cameras": [
            {"name": "train_000", "split": "train", "origin": [0, -3, 1], "target": [0, 0, 1.5],
             "up": [0, 0, 1], "fov": 45.0},
            {"origin": [0.5, -3, 1], "target": [0, 0, 1], "up": [0, 0, 1], "fov": 60},
            {"split": "heldout", "w": 16, "h": 16, "fl_x": 20, "transform_matrix":
             [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 3], [0, 0, 0, 1]]},
        ]
    }
)  # fmt: skip


def _floats(count: int) -> bytes:
    """Pixels of a picture in little-endian float32."""
    import numpy as np

    return np.linspace(0.1, 2, count, dtype="<f4").tobytes()


def _rgbe() -> Sequence[bytes]:
    return [b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 16 +X 16\n" + bytes([90, 80, 70, 129]) * 256]


def _pfm() -> Sequence[bytes]:
    return [b"PF\n16 16\n-1.0\n" + _floats(768), b"Pf\n16 16\n-1.0\n" + _floats(256)]


# ------------------------------------------------------------------------------------------ scenes

_LIGHT = (
    '<shape type="rectangle" id="lamp"><transform name="to_world"><translate z="3"/></transform>'
    '<emitter type="area"><rgb name="radiance" value="4 3 2"/></emitter></shape>'
)
_SCENE = '<scene version="3.0.0">{}</scene>'
_MATERIALS = _SCENE.format(
    _LIGHT + '<shape type="sphere"><point name="center" x="1" y="0" z="0"/>'
    '<float name="radius" value="0.5"/><bsdf type="twosided" id="red"><bsdf type="diffuse">'
    '<rgb name="reflectance" value="0.6 0.3 0.1"/></bsdf></bsdf></shape>'
    '<shape type="cube"><bsdf type="roughplastic" id="plastic">'
    '<rgb name="diffuse_reflectance" value="0.1 0.3 0.6"/><float name="alpha" value="0.1"/>'
    '<float name="int_ior" value="1.5"/><boolean name="nonlinear" value="false"/></bsdf></shape>'
    '<shape type="disk"><transform name="to_world"><rotate x="1" angle="90"/>'
    '<scale value="2"/></transform><bsdf type="mask"><float name="opacity" value="0.7"/>'
    '<bsdf type="principled"><float name="roughness" value="0.2"/></bsdf></bsdf></shape>'
)
_LIT_BY_ALL = _SCENE.format(
    '<default name="size" value="16"/>'
    '<sensor type="perspective"><float name="fov" value="40"/><transform name="to_world">'
    '<lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform><film type="hdrfilm">'
    '<integer name="width" value="$size"/><integer name="height" value="$size"/></film></sensor>'
    '<emitter type="constant"><rgb name="radiance" value="1 1 1"/></emitter>'
    '<emitter type="point"><spectrum name="intensity" value="400:1, 700:2"/>'
    '<point name="position" x="0" y="2" z="0"/></emitter>'
    '<bsdf type="bumpmap" id="rough"><texture type="bitmap" name="bump">'
    '<string name="filename" value="bump.exr"/></texture><bsdf type="principled">'
    '<texture type="bitmap" name="base_color"><string name="filename" value="bump.exr"/></texture>'
    "</bsdf></bsdf>"
    '<shape type="shapegroup" id="group"><shape type="sphere"><ref id="rough"/></shape></shape>'
    '<shape type="instance"><ref id="group"/><transform name="to_world"><translate x="2"/>'
    "</transform></shape>"
    '<shape type="ply"><string name="filename" value="mesh.ply"/><ref id="rough"/></shape>'
)
_ROOM = _SCENE.format(
    _LIGHT + '<shape type="{kind}"><string name="filename" value="mesh.{kind}"/>'
    '<bsdf type="diffuse" id="grey"/></shape>'
)
_ASCII_PLY = """ply
format ascii 1.0
comment a square
element vertex 4
property float x
property float y
property float z
property float nx
property float ny
property float nz
property float u
property float v
element face 2
property list uchar int vertex_indices
end_header
0 0 0 0 0 1 0 0
1 0 0 0 0 1 1 0
1 1 0 0 0 1 1 1
0 1 0 0 0 1 0 1
3 0 1 2
3 0 2 3
"""
_OBJ = """# a square
o square
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
vt 0 0
vt 1 0
vt 1 1
vn 0 0 1
f 1/1/1 2/2/1 3/3/1
f 1//1 3//1 4//1
"""
_TINY = """
steps = 2
pixels = 8
[materials.albedo.neural]
width = 8
hidden = 1
grid = { levels = 2, table_log2 = 8, base_resolution = 2 }
[materials.roughness.neural]
width = 8
hidden = 1
grid = { levels = 2, table_log2 = 8, base_resolution = 2 }
[radiance.neural]
width = 8
hidden = 1
grid = { levels = 2, table_log2 = 8, base_resolution = 2 }
"""


@cache
def _tiny_settings():
    from unbake.config.toml import from_toml

    return from_toml(_TINY)


@cache
def _camera():
    from unbake.dataset.camera import Camera

    return Camera.look_at((0, -3, 1), (0, 0, 0), (0, 0, 1), 45, 8, 8)


def _make_scene(folder: Path) -> None:
    """Make the problem of a fit, and look around in its scene."""
    from unbake.dataset.poses import check_cameras
    from unbake.training.problem import make_problem

    problem = make_problem(folder / "scene.xml", "visible", _tiny_settings(), 0.3)
    check_cameras(problem.scene_view.scene, {"view": _camera()})


def _lit_anew(folder: Path) -> None:
    """Light a scene by what lies in the folder, and make it."""
    from unbake.scene import relight
    from unbake.scene.parse import parse

    scene = parse(folder / "scene.xml")
    relight.turn_off(scene)
    if (folder / "sky.exr").exists():
        relight.put_environment(scene, folder / "sky.exr", 1.0, (0, 0, 1), 0.0)
    else:
        relight.put_lights(scene, folder / "lights.xml")
    scene.instantiate()


def _around_scene(text: str) -> Callable[[Path], None]:
    def prepare(folder: Path) -> None:
        (folder / "scene.xml").write_text(text)
        (folder / "mesh.ply").write_text(_ASCII_PLY)
        shutil.copy(FIRST / "data" / "images" / "train_000.exr", folder / "bump.exr")

    return prepare


# -------------------------------------------------------------------------------------------- runs


def _run(folder: Path) -> None:
    """A run and its data set, with nothing in the log that a page would draw."""
    shutil.copytree(FIRST, folder, dirs_exist_ok=True)
    (folder / "run" / "log.jsonl").write_text('{"step": 60, "seconds": 1.0}\n')


def _report(folder: Path) -> None:
    from unbake.report.page import write_report

    write_report([folder / "run"], folder / "page.html")


def _read_settings(folder: Path) -> None:
    from unbake.config.toml import read_toml, to_toml

    to_toml(read_toml(folder / "settings.toml"))


def _read_origin(folder: Path) -> None:
    from unbake.training.run_folder import RunFolder

    run = RunFolder(folder / "run")
    run.data(run.origin().data).is_dir()


def _load_run(folder: Path) -> None:
    from unbake.training.recovered import load_run

    load_run(folder / "run")


_STATE = "run/checkpoints/step-000000060/state.safetensors"
_OLD_STATE = "run/checkpoints/step-0000060.safetensors"
_MANIFEST = json.dumps(
    {
        "format": 2,
        "step": 60,
        "seconds": 1.5,
        "samples": 7680,
        "run": None,
        "seed": 0,
        "files": {"state.safetensors": {"bytes": 13016, "sha256": "right"}},
        "sha256": "right",
    }
)


def _state() -> Sequence[bytes]:
    """The numbers of a checkpoint of version 0.1, as they are written today."""
    from safetensors.numpy import load, save

    return [save(load((FIRST / _OLD_STATE).read_bytes()))]


def _run_of_today(folder: Path) -> None:
    """A run with a checkpoint of today's format alone."""
    _run(folder)
    (folder / _OLD_STATE).unlink()
    state = folder / _STATE
    state.parent.mkdir()
    state.write_bytes(*_state())
    state.with_name("manifest.json").write_text(_MANIFEST)


def _load_signed_run(folder: Path) -> None:
    """Read a run whose hashes are right whatever was changed, as somebody can make them."""
    with patch("unbake.training.checkpoint.hashlib") as hashes:
        hashes.sha256.return_value.hexdigest.return_value = "right"
        _load_run(folder)


@cache
def _solved() -> dict[str, bytes]:
    """The files of a solved radiance field, a small one, by name."""
    from tempfile import TemporaryDirectory

    from unbake.fields.domain import Domain
    from unbake.fields.radiance import make_radiance
    from unbake.fields.settings import DenseGridConfig
    from unbake.scene.geometry import RAYS
    from unbake.training.solved import write_solved

    settings, domain = DenseGridConfig(3), Domain((0.0, 0.5, 1.0), 2.0)
    radiance = make_radiance("grid", settings, domain, scale=1.0, seed=0)
    told = {
        "representation": "grid",
        "settings": {"cells": 3},
        "domain": {"centre": [0.0, 0.5, 1.0], "extent": 2.0},
        "scale": 1.0,
        "geometry": [0.5] * RAYS,
    }
    manifest = {"format": 1, "scene": "room.xml", "radiance": told, "measurements": [{"step": 60}]}
    with TemporaryDirectory() as folder:
        write_solved(Path(folder), radiance, manifest)
        return {file.name: file.read_bytes() for file in Path(folder).iterdir()}


def _solved_folder(folder: Path) -> None:
    for name, content in _solved().items():
        (folder / name).write_bytes(content)


def _read_solved(folder: Path) -> None:
    from unbake.training.solved import read_solved

    read_solved(folder)


_LOG = "".join(
    json.dumps(row) + "\n"
    for row in (
        {"step": 20, "seconds": 0.5, "samples": 2560, "photometric": 0.3, "skipped": 0,
         "samples_per_second": 5120.0, "memory_mb": 300.0, "learning_rate": 0.001},
        {"step": 40, "seconds": 1.0, "samples": 5120, "photometric": 0.2, "skipped": 1,
         "samples_per_second": 5120.0, "memory_mb": 300.0, "learning_rate": 0.001},
        {"step": 60, "seconds": 1.5, "score": {"views": 1, "albedo_psnr": 20.5}},
        {"step": 60, "seconds": 1.5, "validation": {"split": "heldout", "albedo_psnr": 20.5}},
    )
)  # fmt: skip
_SEARCHES = json.dumps(
    {
        "format": 1,
        "definitions": {},
        "searches": [
            {
                "method": "prb", "data": "room", "kind": "room", "unknown": "materials",
                "views": 4, "heldout": 1, "resolution": [16, 16], "follows_paths": True,
                "settings": {"steps": 2}, "seeds": [0],
                "untrained": {"per_seed": [{"seed": 0, "score": 1.5}], "score": 1.5},
                "trials": [
                    {
                        "factors": {"albedo": 2.0}, "estimator": "two-pass", "score": 2.5,
                        "per_seed": [{"seed": 0, "score": 2.5, "steps": 2, "seconds": 0.5}],
                    }
                ],
                "best": {"factors": {"albedo": 2.0}, "estimator": "two-pass", "score": 2.5},
            }
        ],
    }
)  # fmt: skip


def _read_searches(folder: Path) -> None:
    from unbake.comparison.bench_rates import _read

    _read(folder / "rates.json")


# ---------------------------------------------------------------------------------------- the table

FORMATS: dict[str, Format] = {
    "transforms.json": Format(
        "transforms.json", _told_data_sets, mutations.JSON, _load_data, _data_set, 3
    ),
    "cameras": Format("cameras.json", _texts(CAMERAS), mutations.JSON, _read_cameras, weight=3),
    "emission.json": Format(
        "truth/emission.json", _files("data/truth/emission.json"), mutations.JSON, _read_emission,
        _data_set, 2,
    ),
    "degraded.json": Format(
        "degraded.json", _texts(DEGRADED), mutations.JSON, _read_degraded, _data_set
    ),
    "settings": Format(
        "settings.toml", _files("run/config.toml"), mutations.TOML, _read_settings, weight=3
    ),
    "config.toml": Format(
        "run/config.toml", _files("run/config.toml"), mutations.TOML, _report, _run, 0.6,
        ("page.html",),
    ),
    "origin.json": Format(
        "run/origin.json", _files("run/origin.json"), mutations.JSON, _read_origin, _run
    ),
    "log.jsonl": Format(
        "run/log.jsonl", _texts(_LOG), mutations.JSON_LINES, _report, _run, 0.1, ("page.html",)
    ),
    "metrics.json": Format(
        "run/evaluation/metrics.json", _files("run/evaluation/metrics.json"), mutations.JSON,
        _report, _run, 0.6, ("page.html",),
    ),
    "solve.json": Format(
        "solve.json", lambda: [_solved()["solve.json"]], mutations.JSON, _read_solved,
        _solved_folder,
    ),
    "solved field": Format(
        "radiance.safetensors", lambda: [_solved()["radiance.safetensors"]],
        mutations.SAFETENSORS, _read_solved, _solved_folder, 0.5,
    ),
    "rates.json": Format("rates.json", _texts(_SEARCHES), mutations.JSON, _read_searches),
    "checkpoint": Format(
        _STATE, _state, mutations.SAFETENSORS, _load_signed_run, _run_of_today, 0.5
    ),
    "manifest.json": Format(
        _STATE.replace("state.safetensors", "manifest.json"), _texts(_MANIFEST), mutations.JSON,
        _load_signed_run, _run_of_today, 0.5,
    ),
    "checkpoint 0.1": Format(
        _OLD_STATE, _files(_OLD_STATE), mutations.SAFETENSORS, _load_run, _run, 0.5
    ),
    "evaluated picture": Format(
        "run/evaluation/heldout/heldout_000_albedo.exr",
        _files("run/evaluation/heldout/heldout_000_albedo.exr"), mutations.IMAGE, _report, _run,
        0.3, ("page.html",),
    ),
    "photograph": Format(
        "images/train_001.exr", _files("data/images/train_001.exr"), mutations.IMAGE,
        _load_photographs, _data_set, 3,
    ),
    "photograph pfm": Format(
        "images/train_001.pfm", _pfm, mutations.IMAGE, _load_photographs, _data_set_with("pfm")
    ),
    "photograph rgbe": Format(
        "images/train_001.hdr", _rgbe, mutations.IMAGE, _load_photographs, _data_set_with("hdr")
    ),
    "photograph png": Format(
        "images/train_001.png", _coded("png"), mutations.IMAGE, _load_photographs,
        _coded_data_set("png"),
    ),
    "photograph jpeg": Format(
        "images/train_001.jpg", _coded("jpg"), mutations.IMAGE, _load_photographs,
        _coded_data_set("jpg"),
    ),
    "photograph tiff": Format(
        "images/train_001.tif", _coded("tif"), mutations.IMAGE, _load_photographs,
        _coded_data_set("tif"),
    ),
    "nerfstudio": Format(
        "transforms.json", _nerfstudio, mutations.JSON, _read_foreign, _data_set
    ),
    "picture": Format(
        "picture.exr", _files("data/images/train_001.exr"), mutations.IMAGE, _read_picture, weight=2
    ),
    "scene.xml": Format(
        "scene.xml", _texts(_MATERIALS, _LIT_BY_ALL), mutations.XML, _make_scene, _around_scene(""),
        2.5,
    ),
    "environment map": Format(
        "sky.exr", _files("data/images/train_000.exr"), mutations.IMAGE, _lit_anew,
        _around_scene(_MATERIALS),
    ),
    "lights": Format(
        "lights.xml", _texts(_MATERIALS, _LIT_BY_ALL), mutations.XML, _lit_anew,
        _around_scene(_MATERIALS),
    ),
    "ply": Format(
        "mesh.ply",
        lambda: [_ASCII_PLY.encode(), *_files("data/scene/meshes/tall.ply")()], mutations.MESH,
        _make_scene, _around_scene(_ROOM.format(kind="ply")), 2,
    ),
    "obj": Format(
        "mesh.obj", _texts(_OBJ), mutations.TEXT, _make_scene,
        _around_scene(_ROOM.format(kind="obj")), 1,
    ),
    "texture": Format(
        "bump.exr", _files("data/images/train_000.exr"), mutations.IMAGE, _make_scene,
        _around_scene(_LIT_BY_ALL), 0.7,
    ),
}  # fmt: skip
