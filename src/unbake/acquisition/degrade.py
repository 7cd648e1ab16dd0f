"""Turn a rendered data set into what cameras deliver, and keep the truth of every fault beside it.

A photograph is, channel by channel,

    decode(response(clip(gain · exposure · balance · vignetting · radiance + noise)))

where `gain` is common to all views and puts white at 1, and `decode` is the inverse of the sRGB
curve, by which programs read photographs. Each fault has random numbers of its own: it is the same
alone and together with others.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, final

import drjit as dr
import mitsuba as mi
import numpy as np
from PIL import Image

from ..dataset.camera import Camera
from ..dataset.data_folder import DataFolder
from ..dataset.small_views import seen_by, small_camera
from ..dataset.views import TRUE_MATERIALS, Dataset, SensorNoise, View, fitted, read_masked
from ..errors import UserError, require_kind
from ..imaging.pictures import to_bytes, write_exr, write_png
from ..imaging.srgb import from_srgb, to_srgb
from ..io import filled_folder, require_new_folder, write_atomically, write_json
from ..scene import free_space
from ..scene.parse import ParsedScene, parse, referenced, write
from ..scene.triangles import save_mesh, triangles_of
from .decimate import FEWEST, decimated
from .settings import DegradeSettings

#: Entries of the table of a response.
_TABLE = 257
#: Of files, by format.
_SUFFIXES = {"exr": ".exr", "png": ".png", "jpeg": ".jpg"}
#: Values of each kind of random numbers.
_EXPOSURE, _BALANCE, _NOISE, _POSE, _MESH = range(5)
#: Plugins of meshes in files, which can be displaced.
_MESHES = ("ply", "obj", "serialized")
#: Of the displacement: waves, and their shortest and longest length in diagonals of the scene.
_WAVES, _LENGTHS = 24, (0.05, 0.5)
#: The code value from which on pixels of a JPEG file count as clipped.
_JPEG_WHITE = 250
#: Pillow's names of resolutions of colour.
_SUBSAMPLING = {"half": "4:2:0", "full": "4:4:4"}
#: How much an S-shaped response differs from the sRGB curve.
_CONTRAST = 0.5
#: How much steeper than the sRGB curve a lifted response is at black.
_LIFT = 0.6


@final
@dataclass(frozen=True)
class CameraTruth:
    """What a camera did to one photograph.

    Args:
        exposure: photograph over radiance, before the response: gain and jitter.
        white_balance: factors of red, green and blue.
    """

    exposure: float
    white_balance: tuple[float, float, float]


def degrade(
    data: str | Path,
    out: str | Path,
    settings: DegradeSettings,
    *,
    allow_outside: bool = False,
    tell: Callable[[str], None] = print,
) -> Dataset:
    """Write a degraded copy of a data set, with scene and true materials.

    Args:
        data: folder of the data set.
        out: folder to write, new or empty; it appears only when it is complete.
        settings: what is done to photographs, poses and meshes.
        allow_outside: read files of the data set that lie outside of its folder.
        tell: called with lines of progress.

    Raises:
        UserError: the data set cannot be read, is degraded already, or is of a camera, or `out` is
            not empty.
    """
    require_kind(settings, DegradeSettings, "settings", "unbake.DegradeSettings(exposure=1)")
    out = Path(out)
    require_new_folder(out)
    dataset = Dataset.load(data, allow_outside=allow_outside)
    if DataFolder(dataset.folder).degraded_file.exists():
        what = "the data set is degraded already, and the truth of that would be lost"
        remedy = "Degrade what it was made of, with all options at once"
        raise UserError(what, dataset.folder, remedy)
    if any(view.clipped is not None or view.noise is not None for view in dataset.views):
        what = "the photographs are of a camera already: they tell where they clip, or their noise"
        raise UserError(what, dataset.folder, "Degrade photographs that were rendered")
    cameras, diagonal = [view.camera for view in dataset.views], 0.0
    if settings.pose_jitter or settings.displace:
        scene = parse(dataset.scene, dataset.root).instantiate(merge=False)
        diagonal = free_space.extent(scene)[2]
        cameras = _moved(scene, cameras, settings)
    # Once more: the nodes of a scene that was instantiated cannot be written.
    parsed = parse(dataset.scene, dataset.root)
    gain = _gain(dataset, settings)
    truths = _camera_truths(dataset.views, gain, settings)
    lost = settings.format == "jpeg" and dataset.background == "hidden"
    masked = lost or any(view.mask is not None for view in dataset.views)
    with filled_folder(out) as partial:
        folder = DataFolder(partial)
        folder.scene.mkdir()
        changed = settings.displace or settings.decimate < 1
        displaced, bare = [], False
        if changed:
            displaced, bare = _change_meshes(parsed, folder, settings, diagonal)
        render = dataset.render | ({TRUE_MATERIALS: False} if bare else {})
        path = write(parsed, folder.scene.resolve())
        views = []
        for number, (view, truth) in enumerate(zip(dataset.views, truths, strict=True)):
            pixels, counted = _photograph(view, number, truth, dataset.background, settings)
            degraded = replace(
                view,
                camera=cameras[number],
                image=folder.image(view.name, _SUFFIXES[settings.format]),
                encoding="linear" if settings.format == "exr" else "srgb",
                mask=folder.mask(view.name) if masked else None,
                exposure=truth.exposure if settings.tell_exposures else gain,
                clipped=_clipped(settings),
                noise=_noise(settings),
            )
            _write_photograph(degraded.image, pixels, dataset.background, settings)
            if degraded.mask is not None:
                write_png(degraded.mask, to_bytes(counted))
            _copy_truth(view, folder)
            views.append(degraded)
        _copy_lighting(DataFolder(dataset.folder, allow_outside), folder)
        replace(dataset, scene=path, views=tuple(views), render=render).save(partial)
        write_json(
            folder.degraded_file,
            _truth(dataset, truths, gain, settings, displaced, diagonal),
            allow_nan=False,
        )
    tell(f"degraded {len(truths)} photographs; the truth of it is in degraded.json")
    if bare:
        tell(
            "note: meshes lost their texture coordinates, so that the scene no longer has its true "
            "materials: nothing can be compared with renderings of them, nor its light be fitted"
        )
    return Dataset.load(out)


def response(values: np.ndarray, kind: str) -> np.ndarray:
    """What a program reads of linear values in [0, 1]: decoded by sRGB, encoded by the camera.

    Args:
        kind: see `DegradeSettings.response`.
    """
    if kind == "gamma":
        return from_srgb(np.power(values, 1 / 2.2))
    if kind == "contrast":
        code = to_srgb(values)
        return from_srgb(code + _CONTRAST * (code * code * (3 - 2 * code) - code))
    if kind == "lifted":
        code = to_srgb(values)
        return from_srgb(code + _LIFT * code * (1 - code))
    return values


def vignetting(camera: Camera, lost: float) -> np.ndarray:
    """The share of the light that arrives at pixels, (height, width): 1 − lost · (r / corner)²."""
    x = (np.arange(camera.width) + 0.5) / camera.width - 0.5
    y = (np.arange(camera.height) + 0.5) / camera.height - 0.5
    scale = camera.width**2 + camera.height**2
    square = ((x * camera.width) ** 2 + ((y * camera.height) ** 2)[:, None]) / (scale / 4)
    return 1 - lost * square


def _random(settings: DegradeSettings, *which: int) -> np.random.Generator:
    return np.random.default_rng([settings.seed, *which])


# -------------------------------------------------------------------------------------- photographs


def _gain(dataset: Dataset, settings: DegradeSettings) -> float:
    """The factor that puts white at 1, by pixels that count; 1 where nothing is clipped."""
    if settings.white is None:
        return 1.0
    found = []
    for view in dataset.train:
        pixels, mask = read_masked(view)
        kept = pixels[fitted(pixels, mask, dataset.background)]
        found.append(kept[:, :3].max(axis=1) / view.exposure)
    brightest = np.concatenate(found)
    white = float(np.quantile(brightest, 1 - settings.white)) if len(brightest) else 0.0
    return 1 / white if white > 0 else 1.0


def _camera_truths(
    views: tuple[View, ...], gain: float, settings: DegradeSettings
) -> list[CameraTruth]:
    """Exposures and white balances; those of the first training view are without jitter."""
    anchor = next(i for i, view in enumerate(views) if view.split == "train")
    stops = _random(settings, _EXPOSURE).uniform(-1, 1, len(views)) * settings.exposure
    tint = _random(settings, _BALANCE).uniform(-1, 1, len(views)) * settings.white_balance
    stops[anchor] = tint[anchor] = 0
    return [
        CameraTruth(gain * 2.0 ** float(s), (2.0 ** (0.5 * t), 1.0, 2.0 ** (-0.5 * t)))
        for s, t in zip(stops.tolist(), tint.tolist(), strict=True)
    ]


def _photograph(
    view: View, number: int, truth: CameraTruth, background: str, settings: DegradeSettings
) -> tuple[np.ndarray, np.ndarray]:
    """The degraded photograph, (height, width, 4), and which of its pixels count."""
    pixels, unmasked = read_masked(view)
    rgb = pixels[..., :3].astype(np.float64) / view.exposure
    rgb *= truth.exposure * np.array(truth.white_balance)
    rgb *= vignetting(view.camera, settings.vignetting)[..., None]
    seen = fitted(pixels, None, background)
    if settings.electrons:
        rng = _random(settings, _NOISE, number)
        counted = rng.poisson(np.minimum(rgb, 1e3) * settings.electrons)
        counted = counted + rng.normal(0, settings.read_noise, rgb.shape)
        # What is hidden behind the scene stays black
        rgb = np.where(seen[..., None], counted / settings.electrons, rgb)
    rgb = np.maximum(rgb, 0)
    if settings.white is not None:
        rgb = response(np.minimum(rgb, 1), settings.response)
    return np.dstack([rgb, pixels[..., 3]]), seen if unmasked is None else seen & unmasked


def _clipped(settings: DegradeSettings) -> float | None:
    """The value from which on photographs are clipped: JPEG makes white a little darker."""
    if settings.white is None:
        return None
    return float(from_srgb(np.array(_JPEG_WHITE / 255))) if settings.format == "jpeg" else 1.0


def _noise(settings: DegradeSettings) -> SensorNoise | None:
    """What is told of the noise of photographs."""
    if not settings.tell_noise:
        return None
    return SensorNoise(1 / settings.electrons, settings.read_noise / settings.electrons)


def _write_photograph(
    file: Path, pixels: np.ndarray, background: str, settings: DegradeSettings
) -> None:
    """Write decoded values as they are, or as 8-bit code values; JPEG files hold no alpha."""
    if settings.format == "exr":
        write_exr(file, pixels)
        return
    if settings.format == "png" and background == "hidden":
        # Files of codes are not premultiplied.
        alpha = pixels[..., 3:]
        straight = to_srgb(pixels[..., :3] / np.where(alpha > 0, alpha, 1))
        write_png(file, np.dstack([to_bytes(straight), to_bytes(alpha)]))
        return
    codes = to_bytes(to_srgb(pixels[..., :3]))
    if settings.format == "png":
        write_png(file, codes)
        return
    image, subsampling = Image.fromarray(codes), _SUBSAMPLING[settings.chroma]
    quality = settings.quality
    write_atomically(
        file, lambda p: image.save(p, "JPEG", quality=quality, subsampling=subsampling)
    )


# --------------------------------------------------------------------------------- poses and meshes


def _moved(scene: mi.Scene, cameras: list[Camera], settings: DegradeSettings) -> list[Camera]:
    """Cameras that are turned and moved at random, about half of the error each.

    What pixels see moves by `pose_jitter` pixels, root mean square over all views.
    """
    if not settings.pose_jitter:
        return cameras
    diagonal, draws, points = free_space.bounds(scene)[2], [], []
    every = seen_by(scene, [small_camera(camera) for camera in cameras])
    for number, (camera, seen) in enumerate(zip(cameras, every, strict=True)):
        rng = _random(settings, _POSE, number)
        points.append(seen.position[np.isfinite(seen.distance)])
        away = (camera.origin - points[-1]) @ camera.to_world[:3, 2]
        # A shift moves pixels by the inverse of their depth.
        depth = 1 / math.sqrt(np.mean(away**-2.0)) if len(away) else diagonal
        draws.append((rng.normal(0, 1, 3), rng.normal(0, depth, 3)))

    def moved(size: float) -> list[Camera]:
        return [
            camera.moved(size * turn / camera.fl_x, size * shift / camera.fl_x)
            for camera, (turn, shift) in zip(cameras, draws, strict=True)
        ]

    # Pixels move nearly in proportion: a second look takes the rest into account.
    size = settings.pose_jitter / 2
    for _ in range(2):
        pairs = zip(moved(size), cameras, points, strict=True)
        apart = [one.pixels_from(camera, seen) for one, camera, seen in pairs if len(seen)]
        if any(apart):
            size *= settings.pose_jitter / math.sqrt(np.mean(np.square(apart)))
    return moved(size)


#: Textures that differ over a mesh, by its coordinates or its attributes.
_LOOKED_INTO = ("bitmap", "checkerboard", "mesh_attribute")
#: What stands for values that meshes have lost.
_LOST = 0.5


def _change_meshes(
    parsed: ParsedScene, folder: DataFolder, settings: DegradeSettings, diagonal: float
) -> tuple[list[str], bool]:
    """Move the vertices of all meshes by smooth noise, and leave out some.

    Returns:
        The files it wrote, in the scene's folder, and whether meshes have lost coordinates or
        colours that textures of the scene may look into.
    """
    files, bare = [], False
    textured = any(node.props.plugin_name() in _LOOKED_INTO for node in parsed.state.nodes)
    meshes = {}
    for number, node in enumerate(parsed.state.nodes):
        plugin = node.props.plugin_name()
        if node.type != mi.ObjectType.Shape or plugin not in _MESHES:
            continue
        kept = ("filename", "shape_index", "face_normals", "flip_tex_coords", "to_world")
        made = {key: node.props[key] for key in kept if key in node.props}
        meshes[number] = mi.load_dict({"type": plugin, **made})
        if settings.displace:
            _displace(meshes[number], settings, diagonal)
    dense = {n: mesh for n, mesh in meshes.items() if mesh.face_count() >= FEWEST}
    if settings.decimate < 1:
        of_coordinates = (
            m.has_vertex_texcoords() or m.has_mesh_attributes() for m in dense.values()
        )
        bare = textured and any(of_coordinates)
        few = decimated([triangles_of(mesh) for mesh in dense.values()], settings.decimate)
        meshes |= zip(dense, few, strict=True)
    if bare:
        _without_attributes(parsed)
    for number, mesh in meshes.items():
        node = parsed.state.nodes[number]
        # The name of the file stays, as shapes and lamps without an id are named after it.
        name = f"{Path(node.props['filename']).stem}.ply"
        file = folder.scene / "meshes" / f"changed-{number}" / name
        save_mesh(file, mesh)
        for key in ("shape_index", "flip_tex_coords", "to_world"):
            if key in node.props:
                del node.props[key]
        node.props.set_plugin_name("ply")
        node.props["filename"] = str(file.resolve())
        files.append(file.relative_to(folder.scene).as_posix())
    return files, bare


def _without_attributes(parsed: ParsedScene) -> None:
    """Make constants of what BSDFs look up in colours of vertices, which meshes have lost."""
    for node in parsed.state.nodes:
        if node.type != mi.ObjectType.BSDF:
            continue
        for key in list(node.props):
            texture = referenced(parsed, node.props[key])
            if texture is not None and texture.props.plugin_name() == "mesh_attribute":
                node.props[key] = 1.0 if key == "opacity" else _LOST


def _displace(mesh: mi.Mesh, settings: DegradeSettings, diagonal: float) -> None:
    """Move the vertices of a mesh."""
    positions, _ = triangles_of(mesh)
    positions += displacement(positions, settings, diagonal)
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float(positions.astype(np.float32).ravel())
    params.update()
    dr.eval(params["vertex_positions"])


def displacement(positions: np.ndarray, settings: DegradeSettings, diagonal: float) -> np.ndarray:
    """How vertices are moved, (n, 3) in world units: a sum of waves, equal at equal positions.

    Args:
        positions: (n, 3).
        settings: their root mean square is `displace` diagonals.
        diagonal: of the scene, world units.
    """
    rng = _random(settings, _MESH)
    direction = rng.normal(size=(_WAVES, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    length = diagonal * np.exp(rng.uniform(math.log(_LENGTHS[0]), math.log(_LENGTHS[1]), _WAVES))
    wave = 2 * np.pi * direction / length[:, None]
    amplitude = rng.normal(size=(_WAVES, 3))
    phase = rng.uniform(0, 2 * np.pi, _WAVES)
    size = math.sqrt(float((amplitude**2).sum()) / 2)
    moved = np.sin(positions @ wave.T + phase) @ amplitude
    return settings.displace * diagonal / size * moved


# -------------------------------------------------------------------------------------------- files


def _copy_truth(view: View, folder: DataFolder) -> None:
    for quantity, file in view.truth.items():
        target = folder.truth(quantity, view.name)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(file, target)


def _copy_lighting(source: DataFolder, folder: DataFolder) -> None:
    pairs = {
        source.environment_file: folder.environment_file,
        source.emission_file: folder.emission_file,
    }
    for file, target in pairs.items():
        if source.known(file):
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(file, target)


def _truth(
    dataset: Dataset,
    truths: list[CameraTruth],
    gain: float,
    settings: DegradeSettings,
    displaced: list[str],
    diagonal: float,
) -> dict[str, Any]:
    linear = np.linspace(0, 1, _TABLE)
    return {
        "settings": asdict(settings),
        "gain": gain,
        "clipped": _clipped(settings),
        "response": {
            "linear": linear.tolist(),
            "read": response(linear, settings.response).tolist(),
        },
        "vignetting": {"corner": 1 - settings.vignetting, "falls with": "square of the distance"},
        "displaced": {"meshes": displaced, "world_units": settings.displace * diagonal},
        "triangles": settings.decimate,
        "views": {
            view.name: asdict(truth) | {"transform_matrix": view.camera.to_world.tolist()}
            for view, truth in zip(dataset.views, truths, strict=True)
        },
    }
