"""Evaluation of a run: its renderings and materials against photographs and ground truth."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..config import FitConfig
from ..dataset.data_folder import DataFolder
from ..dataset.fingerprint import changed, fingerprint
from ..dataset.ground_truth import GroundTruth, counted_pixels
from ..dataset.lighting import ROWS, true_environment
from ..dataset.spread import evenly
from ..dataset.views import Dataset, View, read_photograph
from ..errors import UserError, require_kind
from ..imaging.metrics import HIGHEST
from ..imaging.pictures import montage, shown, to_bytes, tonemap, write_exr, write_png
from ..io import read_object
from ..memory import require_memory, size
from ..quantities import ALIGNED, QUANTITIES
from ..scene import edit
from ..scene.parse import parse
from ..training.cameras import Cameras
from ..training.held_aside import convergence
from ..training.recovered import Recovered, load_run, told_changed
from ..training.run_folder import METRICS_FORMAT, EvaluationFolder, RunFolder
from ..training.run_lock import RunLock
from ..training.surroundings import surroundings
from ..training.validation import (
    MaterialBuffers,
    albedos,
    aligned,
    known_pixels,
    psnr_keys,
)
from ..transport.objective import has_radiance
from ..transport.vertex import SceneView
from . import lighting, outliers, renderings, yardsticks
from .forecast import Forecast
from .outliers import evaluate_outliers
from .placing import placed_view, told_of_place
from .renderings import (
    METRICS,
    NOT_FINITE,
    exposure_of,
    mean_scores,
    photographs_of,
    render_camera,
    render_psnr,
    render_scores,
    samples_of,
    scored_views,
    told_not_finite,
)
from .settings import EvaluationSettings
from .yardsticks import Seen, find_yardsticks, seen_materials

#: Memory in bytes that a pixel of a view takes while it is evaluated, and of a view with true
#: materials until all are.
_PIXEL_BYTES, _TRUTH_BYTES = 310, 60

#: Bytes of pictures that are told before they are written.
_MUCH = 1e9

DEFINITIONS = {
    "psnr": f"10 log10(1 / MSE), peak 1, {HIGHEST:g} at most; MSE over unmasked pixels and "
    "channels of a view; the value of a split is the mean over its views. Renderings: both "
    "pictures clipped to [0,1], because one caustic pixel of a photograph would decide all; "
    "render_psnr_unclamped does not. Quantities of materials are not clipped. Renderings are "
    "compared as photographs show them: times the exposure of the view, and no brighter than the "
    "value at which it is clipped",
    "true_render_psnr": "render_psnr of the scene with its true materials and lights, with as many "
    "samples: the limit that the noise of renderings and photographs sets. Exposures and white "
    "balances that the fit had to find are those that suit this picture best; vignetting, response "
    "and places of cameras are as they were found",
    "colour_space": "linear RGB; roughness is perceptual (GGX alpha = roughness squared)",
    "albedo_psnr_aligned": "the same after each channel of the recovered albedo was multiplied by "
    "one number for all views, which brings it nearest to the truth in the least squares sense",
    "convergence": "of the photometric error on training pixels that no step drew: its "
    "relative change over the last part of the fit (share), and the standard error of that "
    "(noise); both in standard errors where the error was not above zero before",
    "samples": "camera samples traced in training, those of searches of roughness included; of an "
    "estimator with two passes, both count",
    "data_changed": "parts of the data set that differ from those that the run was fit to",
    "mask": "pixels all of whose samples see an optimized material: emitters, mirrors, glass "
    "and background are left out; without truth images every pixel of a photograph counts that is "
    "not masked or transparent",
}


CAMERA_DEFINITIONS = {
    "camera": "what was fitted of the cameras. A photograph is f⁻¹(exposure · white balance · v(r) "
    "· radiance). stops: log2 of the exposure over what the data set tells; the first training "
    "view is the anchor, 0. Red and blue are gains relative to green. Nothing is learned from "
    "other views: theirs are the median ratio of photograph and rendering, and their render_psnr "
    "is that of photographs after their own exposure. vignetting: v = 1 + a r² + b r⁴ + c r⁶, r is "
    "1 in a corner. response: f(u^2.2)^(1/2.2) at equal steps of u from 0 to 1. pixels: how far "
    "the corrected camera moves what it sees in the image, root mean square, moved_pixels: of all "
    "training views; degrees and shift: how far it was turned, and moved in world units; "
    "transform_matrix: where it then stands. Other views are moved to where the rendering is most "
    "like their photograph, and then compared",
}


def evaluate(
    run: Path | str,
    settings: EvaluationSettings | None = None,
    *,
    allow_outside: bool = False,
    tell: Callable[[str], None] = print,
) -> dict:
    """Render a run's views from what it recovered, and compare them with photographs and truth.

    Renderings are path traced with full global illumination, without the radiance field.

    Args:
        run: folder of a fit.
        settings: how to render.
        allow_outside: read files of the data set and its scene that lie outside of its folder.
        tell: called with lines of progress.

    Returns:
        The contents of the run's metrics file. Images are written beside it.

    Raises:
        UserError: the run or its data set cannot be read, the true materials are asked for and the
            data set was not captured by unbake, materials of a view are not finite, or there is no
            room for it in memory or on the disk.

    Paper: Sec. 6, Fig. 6.
    """
    settings = settings or EvaluationSettings()
    require_kind(settings, EvaluationSettings, "settings", "unbake.EvaluationSettings(spp=256)")
    run = Path(run)
    recovered, folder = load_run(run, allow_outside=allow_outside), RunFolder(run)
    if not (recovered.dataset.heldout or settings.train_views):
        what = "no view to evaluate: the data set has no held-out views"
        raise UserError(what, "--train-views", "Give at least 1")
    with folder.lock_evaluation() as lock, folder.new_evaluation() as out:
        metrics = _evaluate(recovered, folder, out, settings, tell, lock)
        lock.require_held()
        folder.replace_evaluation(out, metrics)
    return metrics


def _evaluate(
    recovered: Recovered,
    folder: RunFolder,
    out: EvaluationFolder,
    settings: EvaluationSettings,
    tell: Callable[[str], None],
    lock: RunLock,
) -> dict:
    dataset = recovered.dataset
    origin = folder.origin()
    data_changed = changed(origin.fingerprint, fingerprint(dataset))
    if data_changed:
        tell(told_changed(data_changed))
    true_scene = _true_scene(recovered) if settings.truth else None
    views = [*dataset.heldout, *evenly(dataset.train, settings.train_views)]
    _require_memory(views)
    # First, as the true lighting may be damaged, and views take long
    recovered_lighting = _evaluate_lighting(recovered, out, tell)
    clip = settings.clip_negative or recovered.clip_negative
    exposure = exposure_of(photographs_of(views, clip, tell))
    samples = sum(samples_of(view.camera, settings) for view in views)
    forecast = Forecast(samples * (1 if true_scene is None else 2), tell)
    cameras = Cameras(recovered.problem.camera, dataset.train)
    rows, gains, placed = [], [], []
    materials: list[Seen] = []  # of views with truth alone: those of many views are large
    for given in views:
        lock.require_held()
        view = placed_view(recovered, cameras, given, settings)
        placed.append(view)
        row, seen, truth, gain = _evaluate_view(
            recovered, cameras, view, out, settings, true_scene, exposure, forecast
        )
        rows.append(row)
        gains.append(gain)
        materials.append((None if truth is None else seen, truth))
        told = [k for k in row if k.endswith("_psnr") and (seen is not None or k in METRICS)]
        values = [f"{k.removesuffix('_psnr')} {_db(row[k])}" for k in told]
        tell(f"{view.name}: {', '.join(filter(None, [*values, told_not_finite(row)]))}")
        if len(rows) == 1:
            lock.require_held()
            _require_room(out, views, tell)
    if recovered.config.shares_scale:
        recovered_lighting["albedo_scale"] = _align_albedo(rows, materials)
    measures: dict[str, Any] = {}
    if recovered.config.learns_materials:
        heldout = materials[: len(dataset.heldout)]
        measures["yardsticks"] = asdict(find_yardsticks(dataset, recovered.config, heldout))
    found = _evaluate_cameras(recovered, cameras, placed, gains, tell)
    lacking = evaluate_outliers(recovered, out, tell)
    return {
        "format": METRICS_FORMAT,
        **description(recovered.config),
        "steps": recovered.progress.step,
        "samples": recovered.progress.samples,
        "seconds": round(recovered.progress.seconds, 2),
        "convergence": _convergence(recovered, folder),
        "warm_start": None if origin.warm_start is None else asdict(origin.warm_start),
        **_summaries(rows),
        **measures,
        **recovered_lighting,
        "display_exposure": exposure,
        **found,
        **lacking,
        "per_view": rows,
        "definitions": DEFINITIONS
        | renderings.DEFINITIONS
        | (yardsticks.DEFINITIONS if measures else {})
        | (lighting.DEFINITIONS if recovered_lighting else {})
        | (CAMERA_DEFINITIONS if found else {})
        | (outliers.DEFINITIONS if lacking else {}),
        "data": origin.data,
        "data_changed": data_changed,
        "render": {"spp": settings.spp, "max_depth": settings.max_depth},
        "evaluation": asdict(settings),
    }


def _require_memory(views: Sequence[View]) -> None:
    """Refuse views that are too large, or too many with true materials, for the memory."""
    pixels = {view: view.camera.width * view.camera.height for view in views}
    need = _PIXEL_BYTES * max(pixels.values())
    need += _TRUTH_BYTES * sum(count for view, count in pixels.items() if view.truth)
    remedy = "Take smaller photographs: capture with a lower --resolution, import with --longest"
    require_memory(need, "the evaluation of these views needs", remedy)


def _require_room(
    out: EvaluationFolder, views: Sequence[View], tell: Callable[[str], None]
) -> None:
    """Refuse views whose pictures have no room on the disk, by those of the first one.

    How far pictures are compressed depends on what they show.

    Args:
        views: all of them. Of views, only pictures of the first one are written.
    """
    first, *others = (view.camera.width * view.camera.height for view in views)
    written = sum(file.stat().st_size for file in (out.path / views[0].split).iterdir())
    need, free = written / first * sum(others), shutil.disk_usage(out.path).free
    told = f"the pictures of {len(others)} more views need about {size(need)}"
    if need > free:
        remedy = "Make room there, or take smaller photographs or fewer views"
        raise UserError(f"{told}, {size(free)} are free", out.path.parent, remedy)
    if need > _MUCH:
        tell(f"{told} on the disk")


def description(config: FitConfig) -> dict:
    """The settings that tell runs apart: unknown, quantities, method, fields, estimator and rates.

    `representation` is that of the materials, None if they are known; `radiance` is that of L_θ,
    None if the method has no radiance field; `path_depth` is that of methods that follow paths;
    `rate_factors` are multiples of the fields' rates, None in runs of earlier versions.
    """
    cached = has_radiance(config.chosen_method)
    return {
        "unknown": config.unknown,
        "quantities": list(config.quantities) if config.learns_materials else [],
        "method": config.method,
        "bounces": config.chosen_bounces,
        "prior": config.prior,
        "representation": config.representation if config.learns_materials else None,
        "radiance": config.radiance_representation if cached else None,
        "estimator": config.chosen_estimator,
        "rate_factors": {name: config.rate_factors[name] for name in config.unknowns},
        "path_depth": config.path.chosen_depth if config.follows_paths else None,
    }


def require_true_materials(dataset: Dataset) -> None:
    """Check that the scene of a data set has its true materials, on the meshes of its photographs.

    Raises:
        UserError: they are not known, or the meshes are others.
    """
    if not dataset.has_true_materials:
        known = "unbake capture SCENE --out DATA makes one that does"
        raise UserError("the data set does not hold its true materials", dataset.folder, known)
    if _has_other_meshes(dataset):
        what = "the meshes were displaced or decimated, and are not those of the photographs"
        remedy = "Leave out --truth, or take the data set that was degraded"
        raise UserError(what, dataset.folder, remedy)


def _has_other_meshes(dataset: Dataset) -> bool:
    """Whether `unbake degrade` has changed meshes, by what it wrote down of that."""
    file = DataFolder(dataset.folder, dataset.allow_outside).degraded_file
    if not file.is_file():
        return False
    changed = read_object(file).get("displaced")
    return isinstance(changed, dict) and bool(changed.get("meshes"))


def _true_scene(recovered: Recovered) -> SceneView:
    """The scene that the photographs were rendered from, as the data set holds it."""
    dataset = recovered.dataset
    require_true_materials(dataset)
    parsed = parse(dataset.scene, dataset.root)
    edit.to_principled(parsed)
    specular = recovered.config.transport.max_specular
    return SceneView.of(parsed.instantiate(), None, specular)


def _evaluate_view(
    recovered: Recovered,
    cameras: Cameras,
    view: View,
    out: EvaluationFolder,
    settings: EvaluationSettings,
    true_scene: SceneView | None,
    exposure: float,
    forecast: Forecast,
) -> tuple[dict, MaterialBuffers | None, GroundTruth | None, np.ndarray]:
    problem = recovered.problem
    words = (view.camera, settings, problem.hide_emitters)
    samples = samples_of(view.camera, settings)
    done = forecast.begin(view.name, samples)
    radiance = render_camera(problem.scene_view, *words, done=done)
    photograph = read_photograph(view, settings.clip_negative or recovered.clip_negative)
    truth, seen = GroundTruth.of(view, recovered.config.quantities), None
    if recovered.config.learns_materials:
        seen = seen_materials(problem, view, settings.material_spp)
    alpha = photograph[..., 3] if seen is None else seen.coverage
    mask = counted_pixels(photograph, known_pixels(seen, truth))
    # All that follows is of pictures as the photograph shows them.
    dimmed = cameras.dimmed(view, radiance)
    counted = mask if mask.any() else np.ones_like(mask)
    gain = cameras.gain(view, dimmed[counted], photograph[counted][:, :3])
    radiance = cameras.photographed(view, dimmed, gain)

    pictures = {"render": (radiance, tonemap(radiance))}
    if seen is not None:
        for name, value in seen.values.items():
            rgb = np.repeat(value, 3 // value.shape[-1], -1)
            pictures[name] = rgb, shown(value, QUANTITIES[name].display)
    for name, (linear, picture) in pictures.items():
        write_exr(out.picture(view.split, view.name, name), np.dstack([linear, alpha]))
        write_png(out.picture(view.split, view.name, name, ".png"), picture)

    keys = (*METRICS, *psnr_keys(recovered.config.quantities))
    limits = () if true_scene is None else ("true_render_psnr",)
    row = {"name": view.name, "split": view.split} | dict.fromkeys((*keys, *limits))
    if mask.any():
        compared = view.readable(photograph[..., :3])
        row |= render_scores(radiance, compared, mask, exposure)
        if true_scene is not None:
            done = forecast.begin(f"{view.name}, true materials", samples)
            limit = render_camera(true_scene, *words, done=done)
            dimmed = cameras.dimmed(view, limit)
            own = cameras.own_gain(view, dimmed[mask], photograph[mask][:, :3])
            exposed = cameras.photographed(view, dimmed, own)
            row["true_render_psnr"] = render_psnr(exposed, compared, mask)
    if seen is not None and truth is not None:
        try:
            row |= seen.psnr(truth)
        except UserError as error:
            raise UserError(f"materials: {error.what}", view.name, error.remedy) from None
    return row, seen, truth, gain


def _evaluate_cameras(
    recovered: Recovered,
    cameras: Cameras,
    views: Sequence[View],
    gains: Sequence[np.ndarray],
    tell: Callable[[str], None],
) -> dict[str, Any]:
    """What was fitted of the cameras; empty if all is known.

    Args:
        views: that were evaluated, with the cameras that were found for them.
        gains: of these.
    """
    model, poses, dataset = recovered.problem.camera, recovered.problem.poses, recovered.dataset
    unknown = recovered.config.camera.unknowns
    if not unknown:
        return {}
    train = dataset.train
    found = {"unknown": list(unknown)} | cameras.told()
    fitted = np.ones((len(train), 3)) if model is None else model.gains()
    refined = train
    if poses is not None:
        both = zip(train, poses.cameras(), strict=True)
        refined = tuple(replace(view, camera=camera) for view, camera in both)
    pairs = list(zip(refined, fitted, strict=True))
    pairs += [(v, gain) for v, gain in zip(views, gains, strict=True) if v.split != "train"]
    rows = [{"name": view.name, "split": view.split} for view, _ in pairs]
    if cameras.solves:
        found["anchor"] = train[0].name
        rows = [r | cameras.told_of(*pair) for r, pair in zip(rows, pairs, strict=True)]
        stops = [row["stops"] for row in rows if row["split"] == "train"]
        tell(
            f"exposures: {min(stops):+.2f} to {max(stops):+.2f} stops over what the data set tells"
        )
    if poses is not None:
        given = {view.name: view.camera for view in dataset.views}
        scene = recovered.problem.scene_view.scene
        places = [told_of_place(scene, given[view.name], view.camera) for view, _ in pairs]
        found_at = [{"transform_matrix": view.camera.to_world.tolist()} for view, _ in pairs]
        rows = [r | p | at for r, p, at in zip(rows, places, found_at, strict=True)]
        pixels = [row["pixels"] for row in rows if row["split"] == "train"]
        rms = float(np.sqrt(np.mean(np.square(pixels))))
        tell(f"poses: corrected by {rms:.2f} pixels, {max(pixels):.2f} at most")
        found["moved_pixels"] = rms
        keys = ("fl_x", "fl_y", "cx", "cy")
        if "intrinsics" in unknown:
            found["intrinsics"] = [
                {key: getattr(camera, key) for key in keys}
                | {f"told_{key}": getattr(told, key) for key in keys}
                for told, camera in poses.intrinsics()
            ]
    if cameras.solves or poses is not None:
        found["images"] = rows
    return {"camera": found}


def _evaluate_lighting(
    recovered: Recovered, out: EvaluationFolder, tell: Callable[[str], None]
) -> dict:
    """Scores and images of the lighting; empty if the run did not optimize it."""
    problem, data = recovered.problem, recovered.dataset
    found: dict[str, Any] = {}
    if problem.environment is not None:
        map_ = problem.environment.to_latlong(ROWS)
        truth = true_environment(data.folder, allow_outside=data.allow_outside)
        write_exr(out.environment(), map_)
        tiles = [[tonemap(map_)]] if truth is None else [[tonemap(map_)], [tonemap(truth)]]
        write_png(out.environment(".png"), montage(tiles))
        told = surroundings(recovered, ROWS)
        found["environment"] = None
        found["environment_seen_share"] = told.share
        if truth is not None:
            seen = told.lit if told.note else None
            found["environment"] = numbers = lighting.compare_environments(map_, truth, seen)
            tell(", ".join(f"environment {k} {v:.3g}" for k, v in numbers.items()))
        if told.note:
            write_png(out.unobserved_environment(), to_bytes(~told.lit))
            tell(f"note: {told.note}, which lights nothing in view")
    if problem.emission is not None:
        found["emission"] = [
            asdict(x)
            for x in lighting.recovered_emitters(
                problem, data.folder, allow_outside=data.allow_outside
            )
        ]
        for row in found["emission"]:
            error = row["emission_error"]
            off = "" if error is None else f", {100 * error:.2f} % off"
            tell(f"{row['name']}: {' '.join(f'{x:.4g}' for x in row['strength'])}{off}")
    return found


def _align_albedo(rows: list[dict], materials: Sequence[Seen]) -> list[float] | None:
    """Add `albedo_psnr_aligned` to rows; returns the factor of each channel; see `aligned`."""
    scale, scores = aligned([albedos(seen, truth) for seen, truth in materials])
    for row, score in zip(rows, scores, strict=True):
        row[ALIGNED] = score
    return None if scale is None else [float(x) for x in scale]


def _convergence(recovered: Recovered, folder: RunFolder) -> dict | None:
    """What the error on held-aside pixels says of the fit; None where too little was measured."""
    try:
        log = folder.log()
    except UserError:  # a run may be evaluated without its log
        return None
    last = recovered.progress.step
    kept = [line for line in log if line.get("step", 0) <= last]
    found = convergence(kept, "seconds" if recovered.config.seconds else "step")
    return None if found is None else asdict(found)


def _summaries(rows: list[dict]) -> dict[str, Any]:
    """Means of each split, and of how many views they are where that is not all."""
    keys = [key for key in rows[0] if key not in ("name", "split", NOT_FINITE)]
    splits = {name: [r for r in rows if r["split"] == name] for name in ("heldout", "train")}
    scored = {name: scored_views(chosen, keys) for name, chosen in splits.items()}
    scored = {name: found for name, found in scored.items() if found}
    means = {name: mean_scores(chosen, keys) for name, chosen in splits.items()}
    return means | ({"scored": scored} if scored else {})


def _db(value: float | None) -> str:
    return "—" if value is None else f"{value:.1f} dB"
