"""Memory of each process of a fit, by the photographs that it holds.

    python benchmarks/ranks_memory.py --work FOLDER --out FILE.json [--ranks 1 2 4]
        [--presets paper cpu]

Data sets are made of the built-in room's cameras, with noise for photographs: as many and as large
as `CASES` say. Fits of a few steps are run on each by 1, 2 and 4 processes of this machine, with
the preset's fields and small batches, and each process tells its peak of resident memory. That of
process i is, by least squares over all of them,

    a + b (pixels that it holds) + c (pixels of the largest photograph) + d (1 where it leads)

The memory that a step takes by its batch is measured as `unbake fit` forecasts it. From both
follows what a process takes with `PHOTOGRAPHS` photographs of `PIXELS` pixels and the preset's
whole batch: a model, not a measurement, but for a, b, c, d and the step.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import here

import numpy as np
from small_run import mpiexec

from unbake import backend
from unbake.config import FitConfig, preset
from unbake.dataset.data_folder import DataFolder
from unbake.dataset.shares import dealt
from unbake.dataset.views import Dataset, View
from unbake.io import write_json
from unbake.machine import machine

#: Views of a data set, and their width and height in pixels. Each takes less than goes to a file.
CASES = [(5, 1632, 1224), (10, 1632, 1224), (40, 800, 600), (150, 400, 300)]
#: What is worked out: so many photographs, of so many pixels each, for so many processes.
PHOTOGRAPHS, PIXELS, RANKS = 1000, 2_000_000, (1, 8, 64)
#: Steps of each fit, and pixels of a batch for each process: a square, for presets that draw crops.
STEPS, BATCH = 4, 64
#: Pixels of the batch whose memory is forecast.
FORECAST = 512


def main() -> None:
    """Measure, work out the rest, and write both."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path, required=True, help="folder for data and runs")
    parser.add_argument("--ranks", type=int, nargs="+", default=[1, 2, 4])
    parser.add_argument("--presets", nargs="+", default=["paper", "cpu"])
    parser.add_argument("--out", type=Path, help="JSON file to write")
    parser.add_argument("--measure", nargs=2, metavar=("DATA", "JOB"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    backend.activate()
    if args.measure:
        (name,), (data, job) = args.presets, args.measure
        return forecast(Path(data), name) if job == "step" else peaks(Path(data), args.work, name)
    if args.out is None:
        parser.error("--out is needed")
    folders = {case: made(args.work, *case) for case in CASES}
    found = [measured(name, folders, args.ranks, args.work) for name in args.presets]
    model = {"photographs": PHOTOGRAPHS, "pixels": PIXELS, "steps": STEPS}
    write_json(args.out, {"machine": machine(), **model, "presets": found})
    return None


# --------------------------------------------------------------------------------------- Data sets


def made(work: Path, views: int, width: int, height: int) -> Path:
    """A data set of so many views of noise, which are links to one file."""
    base, folder = work / "base", work / f"{views}-views-{width}x{height}"
    if folder.is_dir():
        return folder
    if not base.is_dir():
        words = "capture cornell --views 1 --held-out 1 --resolution 16 --spp 1 --max-depth 2"
        subprocess.run([*_unbake(), *words.split(), "--out", base], check=True)
    data, known = DataFolder(folder), Dataset.load(base)
    data.image("any").parent.mkdir(parents=True)
    shutil.copytree(DataFolder(base).scene, data.scene)
    noise = folder / "noise.exr"
    _write_noise(noise, width, height)
    (view,), (heldout,) = known.train, known.heldout
    camera, scale = view.camera, width / view.camera.width
    size = {"width": width, "height": height}
    lens = {name: getattr(camera, name) * scale for name in ("fl_x", "fl_y", "cx", "cy")}
    camera = dataclasses.replace(camera, **size, **lens)
    for number in range(views):
        os.link(noise, data.image(f"{number:04}"))
    os.link(heldout.image, data.image(heldout.name))
    train = [View(f"{i:04}", "train", camera, data.image(f"{i:04}"), {}) for i in range(views)]
    shown = dataclasses.replace(heldout, image=data.image(heldout.name), truth={})
    scene = data.scene / known.scene.relative_to(DataFolder(base).scene)
    dataclasses.replace(known, folder=folder, scene=scene, views=(*train, shown)).save(folder)
    return folder


def _write_noise(file: Path, width: int, height: int) -> None:
    import mitsuba as mi

    rng = np.random.default_rng(0)
    noise = rng.uniform(0.1, 0.5, (height, width, 3)).astype(np.float16)
    mi.Bitmap(noise).write(str(file))


def _unbake() -> list[str]:
    return [sys.executable, "-m", "unbake"]


# ------------------------------------------------------------------------------------ Measurements


def measured(
    name: str, folders: dict[tuple[int, int, int], Path], ranks: list[int], work: Path
) -> dict[str, Any]:
    """The peaks of all processes with a preset, their line, and what follows for many."""
    rows = []
    for (views, width, height), data in folders.items():
        for count in ranks:
            found = run(data, "fit", name, work, count)
            each = np.diff(np.cumsum([0] + [width * height] * views)[_dealt(views, count)])
            for rank, (held, peak) in enumerate(zip(each.tolist(), found, strict=True)):
                row = {"views": views, "width": width, "height": height, "ranks": count}
                rows.append(row | {"rank": rank, "held_pixels": held, "peak_bytes": peak})
            print(f"{name}, {views} views, {count} processes: {found}", flush=True)
    columns = [[1, r["held_pixels"], r["width"] * r["height"], r["rank"] == 0] for r in rows]
    peaks, matrix = np.array([r["peak_bytes"] for r in rows], float), np.array(columns, float)
    # Columns of about one size, else the solution loses digits
    scale = np.abs(matrix).max(0)
    line = np.linalg.lstsq(matrix / scale, peaks, rcond=None)[0] / scale
    off = float(np.abs(matrix @ line - peaks).max())
    step = run(folders[CASES[0]], "step", name, work, 1)
    print(f"{name}: {line.tolist()}, off by {off:.3g} at most, step {step}", flush=True)
    names = ("fixed_bytes", "bytes_a_pixel", "bytes_a_pixel_of_the_largest", "leading_bytes")
    fitted = dict(zip(names, line.tolist(), strict=True)) | {"largest_deviation": off}
    config = preset(name)
    modelled = [_modelled(fitted, step["a_pixel"], config, count) for count in RANKS]
    about = {"preset": name, "batch": config.pixels, "step_bytes_a_pixel": step["a_pixel"]}
    return about | fitted | {"modelled": modelled, "rows": rows}


def _modelled(fitted: dict[str, float], a_pixel: float, config: FitConfig, ranks: int) -> dict:
    """What the leading one of so many processes takes, by what for."""
    views = int(np.diff(_dealt(PHOTOGRAPHS, ranks)).max())
    fixed = fitted["fixed_bytes"] + fitted["leading_bytes"]
    fixed += fitted["bytes_a_pixel_of_the_largest"] * PIXELS
    parts = {
        "fixed_bytes": fixed,
        "step_bytes": a_pixel * config.pixels / ranks,
        "photograph_bytes": fitted["bytes_a_pixel"] * views * PIXELS,
    }
    return {"ranks": ranks, "photographs": views, **parts, "bytes": sum(parts.values())}


def _dealt(views: int, ranks: int) -> np.ndarray:
    return dealt([1] * views, ranks)


def run(data: Path, job: str, name: str, work: Path, ranks: int) -> Any:
    """What the first of some processes of this script prints."""
    several = [mpiexec(), "-n", str(ranks)] if ranks > 1 else []
    words = [*several, sys.executable, __file__, "--work", work, "--presets", name]
    words += ["--measure", data, job]
    done = subprocess.run(list(map(str, words)), capture_output=True, text=True, timeout=1800)
    if done.returncode:
        sys.exit(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


def peaks(data: Path, work: Path, name: str) -> None:
    """Print the peak of each process after a short fit; of one of these processes."""
    from tempfile import TemporaryDirectory

    from rich.console import Console

    from unbake.ranks import Ranks
    from unbake.training.loop import fit

    ranks = Ranks.of_environment()
    config = dataclasses.replace(preset(name), pixels=BATCH * ranks.size, steps=STEPS)
    with TemporaryDirectory(dir=work) as folder:
        out = ranks.gather(folder)[0]
        console = Console(quiet=True)
        fit(data, Path(out) / "run", config, console=console, ranks=ranks)
        peak = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        every = ranks.gather(peak)
    if ranks.leads:
        print(json.dumps(every))


def forecast(data: Path, name: str) -> None:
    """Print the memory that a step takes, as `unbake fit` forecasts it."""
    from unbake.training.fresh_fit import begin_fit

    config = dataclasses.replace(preset(name), pixels=FORECAST, pixel_sampling="all-views")
    fit = begin_fit(Dataset.load(data), config)
    found = fit.step.forecast(fit.state)
    assert found is not None
    print(json.dumps(dataclasses.asdict(found)))


if __name__ == "__main__":
    main()
