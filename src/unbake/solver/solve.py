"""Neural Radiosity: L_θ from the residual of the rendering equation alone (Sec. 3.1)."""

from __future__ import annotations

import os
import shutil
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from rich.console import Console
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from ..acquisition.built_in import SCENES, write_scene
from ..acquisition.capture import posed_cameras, require_scene
from ..acquisition.placement import is_room
from ..acquisition.settings import CaptureSettings
from ..config.tables import update
from ..dataset.camera import Camera, frame_name
from ..errors import UserError
from ..fields.arrays import from_numpy
from ..fields.domain import Domain
from ..fields.grid_sizes import USUAL, sized
from ..fields.radiance import RadianceField, make_radiance
from ..fields.settings import NetworkConfig
from ..formats import check_format
from ..imaging.pictures import tonemap, write_exr, write_png
from ..io import read_object, require_file, require_new_folder, write_atomically, write_json
from ..machine import machine
from ..scene import emitters
from ..scene.parse import parse
from ..signals import cleaned_up, deferred
from ..training.grid_sizes import surface_seen
from ..training.memory import memory_mb
from ..training.monitor import Monitor
from ..transport.operator import attach_albedo, bounce, transported
from ..transport.vertex import SceneView, find_vertex
from ..version import VERSION
from .pictures import both_sides, debiased_relative_mse, path_traced_halves, relative_mse
from .points import SurfacePoints
from .settings import SolveSettings
from .step import SolverStep

#: Format of `solve.json`.
FORMAT = 1
#: Names of the files in the folder.
MANIFEST, FIELD, LOG = "solve.json", "radiance.safetensors", "progress.jsonl"
#: Shares of the length after which both sides are measured.
MEASURED = (0.0, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 3 / 4, 1.0)
#: Steps between looks at the clock, and between lines of the log.
_TIMED, _READ = 8, 32
#: Points that the mean of the direct light is measured at.
_LIT_POINTS = 1 << 15
_DEFINITIONS = {
    "relmse": "mean of (a - b)^2 / (b^2 + 0.01) over all pixels and channels of all pictures; "
    "a: lhs or rhs, b: the path traced reference",
    "relmse_debiased": "the same without the noise of the reference: (a - b) (a - c) in the place "
    "of the square, b and c independent halves of the reference; the noise of a is in it",
    "spp": "samples per pixel of a",
    "lhs": "E + L_theta at the first surface that is not specular",
    "rhs": "one bounce, and L_theta at its end",
    "reference_noise": "expected relMSE of the reference against itself without noise, from two "
    "independent halves of its samples; every relmse has it in it",
    "residual": "mean of (L_theta - T)^2 / (L_theta^2 + epsilon), T a mean of M samples; it keeps "
    "their variance",
    "seconds": "of training, without measurements and without the reference",
    "cpu_seconds": "the same of all cores that were at work for it; on a machine that does nothing "
    "else, at most the seconds times its cores",
}


def solve(
    scene: str | Path,
    out: Path | str,
    settings: SolveSettings | None = None,
    *,
    cameras: Path | str | None = None,
    allow_outside: bool = False,
    console: Console | None = None,
    tell: Callable[[str], None] = print,
) -> dict[str, Any]:
    """Learn the radiance of a scene with known materials and lights, without any path.

    L_θ is trained by the residual of the rendering equation at random points of all surfaces.

    Args:
        scene: a Mitsuba XML file, or the name of a built-in scene.
        out: folder to write; it must be new or empty. L_θ and measurements are written again with
            each measurement, pictures in the end.
        settings: how L_θ is learned and measured.
        cameras: a camera file; None: the built-in scene's own cameras, or automatic placement.
        allow_outside: read files that the scene names and that lie outside of its folder.
        console: shows progress; None: none is shown.
        tell: called with lines about the scene and with measurements.

    Returns:
        The contents of `solve.json`.

    Raises:
        UserError: the scene or the cameras cannot be used, no light reaches a surface, or the
            folder is not empty or cannot be written.

    Paper: Eq. 3, Eq. 4, Sec. 3.1.
    """
    settings, out = settings or SolveSettings(), Path(out)
    require_scene(str(scene))
    require_new_folder(out)
    known = _known_scene(str(scene), settings, cameras, allow_outside)
    seen = surface_seen(known.scene_view.scene, list(known.cameras.values()))
    if seen is None:
        tell("warning: no camera sees any surface: all pictures will be empty")
    network = sized(settings.radiance, seen or USUAL)
    assert isinstance(network, NetworkConfig)
    points = SurfacePoints.of(known.scene_view.scene, settings.seed)
    scale = _direct_light(known.scene_view, points, settings.seed)
    domain = Domain.of(known.scene_view.scene.bbox())
    radiance = make_radiance("neural", network, domain, scale=scale, seed=settings.seed)
    manifest: dict[str, Any] = {
        "format": FORMAT,
        "unbake": VERSION,
        "scene": str(scene),
        "kind": "room" if known.room else "object",
        "settings": asdict(settings),
        "radiance": {"network": asdict(network), "domain": asdict(domain), "scale": scale},
        "machine": machine(),
        "views": list(known.cameras),
        "definitions": _DEFINITIONS,
    }
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"the folder cannot be made ({error.strerror})", out) from None
    run = _Run(known, radiance, points, settings, network, out, manifest, tell)
    run.make_reference()
    run.train(console or Console(quiet=True))
    run.write_pictures()
    return manifest


def load_radiance(folder: Path | str) -> RadianceField:
    """The field L_θ that `solve` wrote.

    Raises:
        UserError: it cannot be read.
    """
    manifest, file = read_object(Path(folder) / MANIFEST), Path(folder) / FIELD
    check_format(manifest, FORMAT, Path(folder) / MANIFEST)
    require_file(file, "field")
    try:
        told = manifest["radiance"]
        network = update(NetworkConfig(), told["network"])
        domain = Domain(tuple(told["domain"]["centre"]), float(told["domain"]["extent"]))
        radiance = make_radiance("neural", network, domain, scale=float(told["scale"]), seed=0)
        found, fresh = load_file(file), radiance.parameters()
    except (KeyError, TypeError, ValueError, SafetensorError) as error:
        raise UserError(f"is no field that can be read ({error})", folder) from None
    if {k: v.shape for k, v in found.items()} != {k: tuple(v.shape) for k, v in fresh.items()}:
        raise UserError("does not fit its settings", file, "Solve the scene again")
    radiance.assign({key: _array(value, fresh[key]) for key, value in found.items()})
    return radiance


@dataclass(frozen=True)
class _Known:
    """A scene with known materials and lights, and its cameras by the names of their pictures."""

    scene_view: SceneView
    cameras: dict[str, Camera]
    room: bool


def _known_scene(
    name: str, settings: SolveSettings, cameras: Path | str | None, allow_outside: bool
) -> _Known:
    made = Path(tempfile.mkdtemp(prefix="unbake-"))
    with cleaned_up(lambda: shutil.rmtree(made, ignore_errors=True)):
        path = write_scene(name, made) if name in SCENES else Path(name)
        root = Path(path.resolve().anchor) if allow_outside else None
        scene = parse(path, root).instantiate()
    emitters.require_emitters(scene, Path(name))
    wanted = CaptureSettings(settings.views, 0, settings.resolution, seed=settings.seed)
    posed = posed_cameras(name, scene, wanted, None if cameras is None else Path(cameras))
    counts: dict[str, int] = {}
    named = {}
    for split, camera in posed:
        counts[split] = counts.get(split, -1) + 1
        named[frame_name(split, counts[split])] = camera
    return _Known(SceneView.of(scene, None, settings.max_specular), named, is_room(scene))


def _direct_light(scene_view: SceneView, points: SurfacePoints, seed: int) -> float:
    """The mean reflected radiance of one bounce: the radiance of the untrained field.

    Raises:
        UserError: no light reaches any surface, or it is not finite.
    """
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, _LIT_POINTS)
    with dr.suspend_grad():
        x = find_vertex(scene_view, points.rays(sampler), mi.Bool(True), sampler)
        step = bounce(scene_view, attach_albedo(scene_view, x), sampler)
        light = dr.mean(transported(step, mi.Color3f(0)))
        mean = float(np.mean(np.array(light)[np.array(x.valid)]))
    if not np.isfinite(mean):
        raise UserError("the direct light is not finite", None, "Check the scene's values")
    if mean <= 0:
        raise UserError("no light reaches any surface", None, "Check where the lights are")
    return mean


@dataclass
class _Run:
    """A field that is learned, and what is written of it."""

    known: _Known
    radiance: RadianceField
    points: SurfacePoints
    settings: SolveSettings
    network: NetworkConfig
    out: Path
    manifest: dict[str, Any]
    tell: Callable[[str], None]
    pictures: dict[str, list[np.ndarray]] = field(default_factory=dict)
    halves: list[list[np.ndarray]] = field(default_factory=list)  #: of the reference

    def make_reference(self) -> None:
        """Path trace the reference, if it is wanted."""
        self.manifest |= {"reference_noise": None, "measurements": [], "finished": False}
        if not self.settings.reference_spp:
            return
        known, cameras = self.known, list(self.known.cameras.values())
        self.tell(f"path tracing the reference, {self.settings.reference_spp} samples a pixel …")
        halves = path_traced_halves(
            known.scene_view.scene, cameras, self.settings, room=known.room, tell=self.tell
        )
        self.halves = [list(half) for half in halves]
        pairs = list(zip(*halves, strict=True))
        reference = [(a + b) / 2 for a, b in pairs]
        self.pictures["reference"] = reference
        # The mean of two halves has the variance of half of their difference.
        noise = relative_mse([(a - b) / 2 + r for (a, b), r in zip(pairs, reference, strict=True)],
                             reference)  # fmt: skip
        self.manifest["reference_noise"] = noise

    def train(self, console: Console) -> None:
        """Take all steps, and measure at `MEASURED`; a signal ends it early."""
        settings, rate = self.settings, self.network.learning_rate
        optimizer = mi.ad.Adam(rate, self.radiance.parameters(), mask_updates=True)
        step = SolverStep(self.known.scene_view, self.radiance, self.points, settings)
        total = settings.seconds or settings.steps
        number, seconds, cpu, skipped, due = 0, 0.0, 0.0, 0, list(MEASURED)
        recent: list[dict[str, mi.Float]] = []

        def done() -> float:
            return (seconds if settings.seconds else number) / total

        with deferred() as stop, Monitor(self.out / LOG, console, total) as monitor:
            self._measure(optimizer, _entry(0, 0.0, 0.0, 0, settings.spp), monitor.say)
            due.pop(0)
            clock, cpu_clock = time.perf_counter(), time.process_time()
            while done() < 1 and not stop:
                now = rate * settings.final_learning_rate ** min(done(), 1.0)
                recent.append(step(optimizer, number, now))
                number += 1
                last = done() >= 1 or bool(stop)
                if not (last or number % _TIMED == 0):
                    continue
                dr.sync_thread()
                seconds, cpu = time.perf_counter() - clock, time.process_time() - cpu_clock
                last = last or done() >= 1
                reached = done() >= due[0]
                if not (last or reached or len(recent) >= _READ):
                    continue
                skipped += _record(monitor, recent, done() * total, number, seconds, settings)
                recent.clear()
                if last or reached:
                    while len(due) > 1 and done() >= due[0]:
                        due.pop(0)
                    spp = settings.final_spp if last else settings.spp
                    entry = _entry(number, seconds, cpu, skipped, spp)
                    self._measure(optimizer, entry, monitor.say)
                    clock, cpu_clock = time.perf_counter() - seconds, time.process_time() - cpu
            for failure in monitor.failures:
                raise failure
        self.manifest["finished"] = not stop
        self._write()

    def write_pictures(self) -> None:
        """Write both sides and the reference as OpenEXR and PNG."""
        for kind, pictures in self.pictures.items():
            for name, picture in zip(self.known.cameras, pictures, strict=True):
                write_exr(self.out / f"{name}-{kind}.exr", picture)
                write_png(self.out / f"{name}-{kind}.png", tonemap(picture))

    def _measure(
        self,
        optimizer: mi.ad.Adam,
        entry: dict[str, Any],
        say: Callable[[str], None],
    ) -> None:
        """Measure both sides now, tell it, and write it with the field.

        Args:
            entry: when this is; it gets what is measured.
        """
        self.radiance.assign(dict(optimizer.items()))
        cameras = list(self.known.cameras.values())
        sides = both_sides(
            self.known.scene_view,
            self.radiance,
            cameras,
            entry["spp"],
            self.settings.seed,
            hide_emitters=not self.known.room,
        )
        reference = self.pictures.get("reference")
        if reference is not None:
            found = {side: relative_mse(images, reference) for side, images in sides.items()}
            entry["relmse"] = found
            entry["relmse_debiased"] = {
                side: debiased_relative_mse(images, self.halves) for side, images in sides.items()
            }
            told = ", ".join(f"{side.upper()} {value:.4f}" for side, value in found.items())
            say(f"step {entry['step']}, {entry['seconds']:.0f} s: relMSE of {told}")
        self.manifest["measurements"].append(entry)
        self.pictures |= sides
        self._write()

    def _write(self) -> None:
        arrays = {key: _numpy(value) for key, value in self.radiance.parameters().items()}
        write_atomically(self.out / FIELD, lambda path: save_file(arrays, os.fspath(path)))
        write_json(self.out / MANIFEST, self.manifest, allow_nan=False)


def _entry(number: int, seconds: float, cpu: float, skipped: int, spp: int) -> dict[str, Any]:
    """The beginning of a measurement in `solve.json`."""
    times = {"seconds": round(seconds, 3), "cpu_seconds": round(cpu, 3)}
    return {"step": number, **times, "skipped": skipped, "spp": spp}


def _record(
    monitor: Monitor,
    recent: list[dict[str, mi.Float]],
    done: float,
    number: int,
    seconds: float,
    settings: SolveSettings,
) -> int:
    """Log and show the steps since the last line; returns how many of them were skipped."""
    skipped = sum(int(terms["skipped"][0]) for terms in recent)
    finite = [v for v in (float(terms["residual"][0]) for terms in recent) if np.isfinite(v)]
    samples = number * settings.batch * settings.samples
    entry = {
        "step": number,
        "seconds": seconds,
        "residual": float(np.mean(finite)) if finite else float("nan"),
        "skipped": skipped,
        "samples_per_second": samples / max(seconds, 1e-9),
        "memory_mb": memory_mb(),
    }
    monitor.record(done, entry)
    return skipped


def _numpy(value: mi.Float | mi.TensorXf) -> np.ndarray:
    return np.array(dr.detach(value))


def _array(value: np.ndarray, like: mi.Float | mi.TensorXf) -> mi.Float | mi.TensorXf:
    flat = from_numpy(mi.Float, value)
    return mi.TensorXf(flat, like.shape) if dr.is_tensor_v(like) else flat
