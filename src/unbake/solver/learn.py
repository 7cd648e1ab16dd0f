"""The radiance of a scene whose materials and lights are known: learned, measured, written."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from rich.console import Console

from ..dataset.camera import Camera
from ..errors import UserError
from ..fields.radiance import RadianceField
from ..fields.settings import FieldSettings
from ..imaging.pictures import tonemap, write_exr, write_png
from ..machine import machine
from ..memory import require_memory
from ..signals import deferred
from ..training.memory import memory_mb
from ..training.monitor import Monitor
from ..training.problem import Parameters, Problem
from ..training.solved import FORMAT, description, write_solved
from ..transport.vertex import SceneView
from ..version import VERSION
from .pictures import (
    both_sides,
    broken_pixels,
    debiased_relative_mse,
    path_traced_halves,
    relative_mse,
)
from .points import SurfacePoints
from .settings import SolveSettings
from .step import SolverStep

LOG = "progress.jsonl"
#: Shares of the length after which both sides are measured.
MEASURED = (0.0, 1 / 32, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 3 / 4, 1.0)
#: Steps between looks at the clock, and between lines of the log.
_TIMED, _READ = 8, 32
#: Seconds of training, about, after which what was learned is written.
_KEPT = 60.0
#: Bytes a pixel of the pictures of both sides, of which two measurements are held at once; and of a
#: reference, with all that they are compared by.
_SIDES_BYTES, _REFERENCE_BYTES = 60, 180
_LEFT_OUT = "are not finite, and left out of relMSE: check the values of scene and materials"
_DEFINITIONS = {
    "step": "of training, after which the field was written; measurements may be of earlier ones",
    "relmse": "mean of (a - b)^2 / (b^2 + 0.01) over all pixels and channels of all pictures; "
    "a: lhs or rhs, b: the path traced reference. Where the mean m of b is below 0.08 or above 1, "
    "0.01 is multiplied by (m / 0.08)^2 or m^2. Pixels that are not finite are left out; it is "
    "null where none is left",
    "not_finite": "pixels of a, or in reference_not_finite of b, that are not finite",
    "relmse_debiased": "the same without the noise of the reference: (a - b) (a - c) in the place "
    "of the square, b and c independent halves of the reference; the noise of a is in it",
    "spp": "samples per pixel of a",
    "lhs": "E + L_theta at the first surface that is not specular",
    "rhs": "one bounce, and L_theta at its end",
    "reference_noise": "expected relMSE of the reference against itself without noise, from two "
    "independent halves of its samples; every relmse has it in it",
    "residual": "mean of (L_theta - T)^2 / (L_theta^2 + epsilon), T a mean of M samples; it keeps "
    "their variance. epsilon follows the scale of L_theta as that of relmse follows m",
    "seconds": "of training, without measurements and without the reference",
    "cpu_seconds": "the same of all cores that were at work for it; on a machine that does nothing "
    "else, at most the seconds times its cores",
    "pictures_seconds": "of the pictures of both sides, all views, on the clock",
    "pictures_cpu_seconds": "of the pictures of both sides, all views, with spp samples a pixel",
}


@dataclass(frozen=True)
class Known:
    """A scene whose materials and lights are known, and the cameras of its pictures by name.

    Args:
        room: whether the scene encloses its cameras, which then see emitters.
        points: of its surfaces.
        told: what `solve.json` tells of it.
        problem: whose fields materials or lights are, of a run; None: they are the scene's own.
    """

    scene_view: SceneView
    cameras: dict[str, Camera]
    room: bool
    points: SurfacePoints
    told: dict[str, Any]
    problem: Problem | None = None

    @property
    def recovered(self) -> Parameters:
        """The arrays of the problem's fields."""
        found = {} if self.problem is None else self.problem.parameters()
        return {key: dr.detach(value) for key, value in found.items()}


@dataclass(frozen=True)
class Start:
    """The radiance field before its first step.

    Args:
        form: name of its representation.
        settings: of that representation.
    """

    radiance: RadianceField
    form: str
    settings: FieldSettings


def learn(
    known: Known,
    start: Start,
    settings: SolveSettings,
    out: Path,
    console: Console | None,
    tell: Callable[[str], None],
) -> dict[str, Any]:
    """Train a field by the residual alone, and write it with pictures and measurements.

    Args:
        known: the scene.
        start: the field, which is changed.
        settings: how it is learned and measured.
        out: folder to write; made where it does not exist.
        console: shows progress; None: none is shown.
        tell: called with measurements.

    Returns:
        The contents of `solve.json`.

    Raises:
        UserError: the pictures do not fit into the memory, or the folder cannot be written.
    """
    _require_memory(known, settings)
    told = asdict(settings)
    del told["radiance"]
    manifest: dict[str, Any] = {
        "format": FORMAT,
        "unbake": VERSION,
        **known.told,
        "kind": "room" if known.room else "object",
        "settings": told,
        "radiance": description(start.radiance, start.form, start.settings, known.scene_view.scene),
        "machine": machine(),
        "views": list(known.cameras),
        "definitions": _DEFINITIONS,
    }
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"the folder cannot be made ({error.strerror})", out) from None
    learning = _Learning(known, start, settings, out, manifest, tell, known.recovered)
    learning.make_reference()
    learning.train(console or Console(quiet=True))
    learning.write_pictures()
    return manifest


def _require_memory(known: Known, settings: SolveSettings) -> None:
    """Refuse pictures for which there is no memory: those of all views are held at once.

    Raises:
        UserError: it names what to lower.
    """
    pixels = sum(camera.width * camera.height for camera in known.cameras.values())
    remedy = "Lower --resolution"
    if known.problem is not None:  # whose pictures are as large as its photographs
        remedy = "Give smaller or fewer --cameras"
    each = _SIDES_BYTES
    if settings.reference_spp:
        each += _REFERENCE_BYTES
        remedy += ", or --reference-spp 0"
    require_memory(each * pixels, f"pictures of {len(known.cameras)} views need", remedy)


@dataclass
class _Learning:
    """A field that is learned, and what is written of it."""

    known: Known
    start: Start
    settings: SolveSettings
    out: Path
    manifest: dict[str, Any]
    tell: Callable[[str], None]
    recovered: Parameters  #: of the fields of materials and lights
    pictures: dict[str, list[np.ndarray]] = field(default_factory=dict)
    halves: list[list[np.ndarray]] = field(default_factory=list)  #: of the reference

    def make_reference(self) -> None:
        """Path trace the reference, if it is wanted."""
        self.manifest |= {"reference_noise": None, "reference_not_finite": 0}
        self.manifest |= {"step": 0, "measurements": [], "finished": False}
        if not self.settings.reference_spp:
            return
        known, cameras = self.known, list(self.known.cameras.values())
        self.tell(f"path tracing the reference, {self.settings.reference_spp} samples a pixel …")
        halves = path_traced_halves(
            known.scene_view, cameras, self.settings, room=known.room, tell=self.tell
        )
        self.halves = [list(half) for half in halves]
        pairs = list(zip(*halves, strict=True))
        with np.errstate(invalid="ignore", over="ignore"):  # pixels that are not finite
            reference = [(a + b) / 2 for a, b in pairs]
            # The mean of two halves has the variance of half of their difference.
            off = [(a - b) / 2 + r for (a, b), r in zip(pairs, reference, strict=True)]
        self.pictures["reference"] = reference
        self.manifest["reference_noise"] = _number(relative_mse(off, reference))
        self.manifest["reference_not_finite"] = broken = broken_pixels(reference)
        if broken:
            self.tell(f"warning: {broken} pixels of the reference {_LEFT_OUT}")

    def train(self, console: Console) -> None:
        """Take all steps, and measure at `MEASURED`; a signal ends it early.

        What was learned is written before the pictures of a measurement, which may take far longer
        than the steps, and once a minute between them.
        """
        settings, rate = self.settings, self.start.settings.learning_rate
        radiance, known = self.start.radiance, self.known
        optimizer = mi.ad.Adam(rate, radiance.parameters(), mask_updates=True)
        step = SolverStep(known.scene_view, radiance, known.points, settings, known.problem)
        total = settings.seconds or settings.steps
        number, seconds, cpu, skipped, due = 0, 0.0, 0.0, 0, list(MEASURED)
        kept = 0.0  # when the field was written last
        recent: list[dict[str, mi.Float]] = []

        def done() -> float:
            return (seconds if settings.seconds else number) / total

        with deferred() as stop, Monitor(self.out / LOG, console, total) as monitor:
            self._measure(optimizer, _entry(0, 0.0, 0.0, 0, settings.spp), monitor.say, stop)
            due.pop(0)
            clock, cpu_clock = time.perf_counter(), time.process_time()
            last = done() >= 1 or bool(stop)
            while not last:
                now = rate * settings.final_learning_rate ** min(done(), 1.0)
                recent.append(step(optimizer, number, now, self.recovered))
                number += 1
                # Looked at once a step, so that all that was learned is measured.
                last = done() >= 1 or bool(stop)
                if not (last or number % _TIMED == 0):
                    continue
                dr.sync_thread()
                seconds, cpu = time.perf_counter() - clock, time.process_time() - cpu_clock
                last = last or done() >= 1
                reached, keep = done() >= due[0], seconds - kept >= _KEPT
                if not (last or reached or keep or len(recent) >= _READ):
                    continue
                skipped += _record(monitor, recent, done() * total, number, seconds, settings)
                recent.clear()
                if not (last or reached or keep):
                    continue
                if last or reached:
                    while len(due) > 1 and done() >= due[0]:
                        due.pop(0)
                    spp = settings.final_spp if last else settings.spp
                    entry = _entry(number, seconds, cpu, skipped, spp)
                    self._measure(optimizer, entry, monitor.say, stop)
                    last = last or bool(stop)  # all that was learned is measured
                else:
                    self._keep(optimizer, number, monitor.say)
                kept = seconds
                clock, cpu_clock = time.perf_counter() - seconds, time.process_time() - cpu
            for failure in monitor.failures:
                raise failure
        self.manifest["finished"] = done() >= 1
        write_solved(self.out, self.start.radiance, self.manifest)

    def write_pictures(self) -> None:
        """Write both sides and the reference as OpenEXR and PNG."""
        for kind, pictures in self.pictures.items():
            for name, picture in zip(self.known.cameras, pictures, strict=True):
                write_exr(self.out / f"{name}-{kind}.exr", picture)
                write_png(self.out / f"{name}-{kind}.png", tonemap(picture))

    def _keep(self, optimizer: mi.ad.Adam, step: int, say: Callable[[str], None]) -> None:
        """Write the field as it is after a step; where that fails, it is tried again later."""
        self.start.radiance.assign(dict(optimizer.items()))
        self.manifest["step"] = step
        self._write(say)

    def _measure(
        self,
        optimizer: mi.ad.Adam,
        entry: dict[str, Any],
        say: Callable[[str], None],
        stop: Sequence[int],
    ) -> None:
        """Write the field, measure both sides now, tell it, and write that with the field.

        Args:
            entry: when this is; it gets what is measured.
            stop: fills at any moment: whoever stops it does not wait for the samples of the end.
        """
        self._keep(optimizer, entry["step"], say)
        if self.known.problem is not None:  # a step that was replayed leaves other arrays there
            self.known.problem.assign(self.recovered)
        cameras = list(self.known.cameras.values())
        sides, few = {}, self.settings.spp
        begun = begun_wall = 0.0
        for spp in (entry["spp"], few):
            begun, begun_wall = time.process_time(), time.perf_counter()
            sides = both_sides(
                self.known.scene_view,
                self.start.radiance,
                cameras,
                spp,
                self.settings.seed,
                hide_emitters=not self.known.room,
                ended=lambda spp=spp: bool(stop) and spp > few,
            )
            entry["spp"] = spp
            if sides:
                break
        entry["pictures_cpu_seconds"] = round(time.process_time() - begun, 3)
        entry["pictures_seconds"] = round(time.perf_counter() - begun_wall, 3)
        entry["not_finite"] = {side: broken_pixels(images) for side, images in sides.items()}
        if any(entry["not_finite"].values()):
            counts = ", ".join(f"{n} of {side.upper()}" for side, n in entry["not_finite"].items())
            say(f"warning: pixels ({counts}) {_LEFT_OUT}")
        reference = self.pictures.get("reference")
        if reference is not None:
            found = {side: relative_mse(images, reference) for side, images in sides.items()}
            entry["relmse"] = {side: _number(value) for side, value in found.items()}
            entry["relmse_debiased"] = {
                side: _number(debiased_relative_mse(images, self.halves))
                for side, images in sides.items()
            }
            told = ", ".join(f"{side.upper()} {value:.4f}" for side, value in found.items())
            say(f"step {entry['step']}, {entry['seconds']:.0f} s: relMSE of {told}")
        self.manifest["measurements"].append(entry)
        self.pictures |= sides
        self._write(say)

    def _write(self, say: Callable[[str], None]) -> None:
        """Write what there is; a disk that is full now may have room in the end."""
        try:
            write_solved(self.out, self.start.radiance, self.manifest)
        except UserError as error:
            say(f"warning: {error}; the training goes on, and it is tried again later")


def _number(value: float) -> float | None:
    """A number for JSON, which has none for what is not finite."""
    return value if math.isfinite(value) else None


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
