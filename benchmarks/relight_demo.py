"""How well recovered materials look under light that no photograph showed, by method.

    python benchmarks/relight_demo.py --work FOLDER --out FILE.json [--scenes demo still]
        [--data NAME=FOLDER ...] [--methods ours direct prb] [--steps 1200 | --seconds 60]
        [--batch PIXELS] [--seeds 0] [--spp 128] [--resolution 128] [--picture FILE.png]

`demo`, a room, is lit by two lamps in other places and colours than its own; `still`, a few
objects, by a sunny sky from another side than the hazy one of its photographs. --data takes
captures of other scenes: rooms are lit by a warm and a cold ball where two of the training cameras
stood, objects by the sunny sky. Each method is fitted to the photographs, with default settings and
the same number of steps or seconds of training. Its materials are rendered from the held-out
cameras under the new light, and compared with a capture of the true scene under it. So are
materials before the first step, `untrained`, those of the first seed. The fits of a seed follow
each other, and the file is written after each seed. A picture has a row for each scene, of one
held-out view: the truth, and what each method made of it with the first seed. What is done in the
folder is kept: data sets, runs, scores.
"""

from __future__ import annotations

import argparse
import contextlib
import math
import shutil
from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import here

import numpy as np

from unbake import backend

backend.activate()

from views import of_size  # noqa: E402

from unbake.acquisition.new_light import axis_of  # noqa: E402
from unbake.config.light import LightConfig  # noqa: E402
from unbake.dataset.camera import up_of  # noqa: E402
from unbake.dataset.views import Dataset  # noqa: E402
from unbake.errors import UserError  # noqa: E402
from unbake.evaluation.evaluate import evaluate  # noqa: E402
from unbake.evaluation.rendering import relight  # noqa: E402
from unbake.evaluation.settings import EvaluationSettings, RenderSettings  # noqa: E402
from unbake.experiments.commands import compile_fit, unbake  # noqa: E402
from unbake.experiments.seeds import across_seeds  # noqa: E402
from unbake.imaging.pictures import (  # noqa: E402
    fitting_exposure,
    montage,
    read_exr,
    sample,
    tonemap,
    write_exr,
    write_png,
)
from unbake.io import read_object, write_json, write_text  # noqa: E402
from unbake.machine import machine  # noqa: E402

#: Samples per pixel of the true pictures.
TRUE_SAMPLES = 576
UNTRAINED = "untrained"
#: Two balls of light, a warm and a cold one: centres and radii.
Balls = tuple[tuple[Sequence[float], float], tuple[Sequence[float], float]]
#: Below the ceiling of `demo`, whose own lamp is off.
LAMPS: Balls = ((3.5, 0.6, 1.9), 0.12), ((0.5, 0.3, 2.3), 0.1)
COLOURS = {"warm": "30 20 11", "cold": "10 17 30"}
#: Radius of balls in other rooms, over the distance between them.
RADIUS = 0.03


def main() -> None:
    """Fit, relight, print every score, and write the result after each seed."""
    args = arguments()
    args.work.mkdir(parents=True, exist_ok=True)
    stop = ("steps", args.steps) if args.seconds is None else ("seconds", args.seconds)
    found: dict[str, Any] = {
        "machine": machine(),
        **dict([stop]),
        "batch": args.batch,
        "spp": args.spp,
        "seeds": [],
        "scenes": {},
    }
    given = {name: Path(folder) for name, _, folder in (x.partition("=") for x in args.data)}
    data = {name: args.work / name for name in args.scenes} | given
    for scene, folder in data.items():
        truth = args.work / f"{scene}-truth"
        if scene not in given and not folder.exists():
            unbake("capture", scene, "--out", folder, "--resolution", args.resolution)
        if not truth.exists():
            light = light_of(scene, folder, args.work)
            capture_truth(scene, folder, truth, light, args.true_spp, args.resolution)
        found["scenes"][scene] = {"data": described(folder, truth), "methods": {}}
    scores: dict[tuple[str, str], list[dict[str, float | None]]] = {}
    for seed in args.seeds:
        for scene, method in product(data, [*args.methods, UNTRAINED]):
            if method == UNTRAINED and seed != args.seeds[0]:
                continue
            run = args.work / f"{scene}-{method}-{seed}"
            if not run.exists():
                fit(data[scene], run, method, args.batch, seed, stop)
            kept = args.work / f"{run.name}-scores-{args.spp}.json"
            if not kept.exists():
                light = light_of(scene, data[scene], args.work)
                truth = args.work / f"{scene}-truth"
                write_json(kept, measure(run, args.work, light, truth, args.spp))
            row = read_object(kept)
            scores.setdefault((scene, method), []).append(row)
            told = ", ".join(f"{k} {v:.2f}" for k, v in row.items() if k.endswith("_psnr"))
            print(f"{scene}, {method}, seed {seed}: {told}", flush=True)
        found["seeds"].append(seed)
        for (scene, method), rows in scores.items():
            found["scenes"][scene]["methods"][method] = across_seeds(rows, rows[0])
        write_json(args.out, found)
    if args.picture is not None:
        runs = [f"{method}-{args.seeds[0]}" for method in (*args.methods, UNTRAINED)]
        rows = [pictured(args.work, scene, runs) for scene in data]
        write_png(args.picture, montage(rows))


def arguments() -> argparse.Namespace:
    """The words of the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path, required=True, help="folder of data sets and runs")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--scenes", nargs="*", choices=("demo", "still"), default=["demo", "still"])
    parser.add_argument("--data", nargs="+", default=[], help="NAME=FOLDER, captured data sets")
    parser.add_argument("--methods", nargs="+", default=["ours", "direct", "prb"])
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--steps", type=int, default=1200)
    length.add_argument("--seconds", type=float, help="of training, instead of steps")
    parser.add_argument("--batch", type=int, help="pixels of a step (default: that of fits)")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--spp", type=int, default=128, help="samples per pixel of relit pictures")
    parser.add_argument("--true-spp", type=int, default=TRUE_SAMPLES)
    parser.add_argument("--resolution", type=int, default=128)
    parser.add_argument("--picture", type=Path, help="PNG file to write")
    return parser.parse_args()


def pictured(work: Path, scene: str, runs: Sequence[str]) -> list[np.ndarray]:
    """The middle one of a scene's held-out views under the new light: the truth, and each run's.

    Returns:
        sRGB bytes, shape (h, w, 3) each.
    """
    heldout = Dataset.load(work / f"{scene}-truth").heldout
    view = heldout[len(heldout) // 2]
    files = [work / f"{scene}-{run}-relit" / f"{view.name}.exr" for run in runs]
    made = [read_exr(file)[..., :3] for file in (view.image, *files)]
    exposure = fitting_exposure([sample(made[0].mean(-1))])
    return [tonemap(picture, exposure) for picture in made]


def fit(
    data: Path, run: Path, method: str, batch: int | None, seed: int, stop: tuple[str, float]
) -> None:
    """Fit a method to photographs, for so many steps or seconds; `untrained` takes no step."""
    name, until = ("steps", 0) if method == UNTRAINED else stop
    options = ["--method", "ours" if method == UNTRAINED else method]
    options += [] if batch is None else ["--batch", batch]
    if name == "seconds":
        compile_fit(data, *options)
    # What was cut off is done again.
    unfinished = run.with_name(f"{run.name}-unfinished")
    shutil.rmtree(unfinished, ignore_errors=True)
    # A fit that learned nothing fails, and is judged as it is; one that left no run fails here.
    with contextlib.suppress(UserError):
        unbake("fit", data, "--out", unfinished, "--seed", seed, *options, f"--{name}", until)
    unfinished.rename(run)


def light_of(scene: str, data: Path, work: Path) -> LightConfig:
    """The light that no photograph of a scene showed; its file is written anew."""
    dataset = Dataset.load(data)
    if dataset.kind == "room":
        file = work / f"{scene}-lamps.xml"
        write_text(file, lamps(LAMPS if scene == "demo" else balls_in(dataset)))
        return LightConfig(lights=file)
    write_exr(work / "sunny.exr", sunny_sky(64))
    up = up_of([view.camera for view in dataset.train])
    return LightConfig(envmap=work / "sunny.exr", envmap_up=axis_of(up))


def balls_in(dataset: Dataset) -> Balls:
    """Balls of light where the first training camera stands, and the one farthest from it."""
    places = np.array([view.camera.origin for view in dataset.train])
    distance = np.linalg.norm(places - places[0], axis=1)
    other = int(np.argmax(distance))
    radius = RADIUS * float(distance[other])
    return (places[0].tolist(), radius), (places[other].tolist(), radius)


def lamps(balls: Balls) -> str:
    """A scene of two balls of light."""
    shapes = [
        f'  <shape type="sphere" id="{name}"><point name="center" x="{x}" y="{y}" z="{z}"/>\n'
        f'    <float name="radius" value="{radius}"/>\n'
        f'    <emitter type="area"><rgb name="radiance" value="{colour}"/></emitter></shape>\n'
        for (name, colour), ((x, y, z), radius) in zip(COLOURS.items(), balls, strict=True)
    ]
    return f'<scene version="3.0.0">\n{"".join(shapes)}</scene>\n'


def sunny_sky(rows: int) -> np.ndarray:
    """A sky with a sun 35 degrees above the horizon: linear RGB radiance, (rows, 2 rows, 3).

    The first row is the zenith.
    """
    θ = np.pi * (np.arange(rows) + 0.5) / rows
    φ = 2 * np.pi * (np.arange(2 * rows) + 0.5) / (2 * rows)
    θ, φ = np.meshgrid(θ, φ, indexing="ij")
    up = np.cos(θ)[..., None]
    zenith, horizon = np.array([0.12, 0.25, 0.6]), np.array([0.7, 0.75, 0.8])
    sky = horizon + (zenith - horizon) * np.sqrt(np.maximum(up, 0))
    ground = np.array([0.16, 0.14, 0.1])
    height, side = math.radians(35), 0.3 * math.pi
    sun = np.sin(θ) * math.cos(height) * np.cos(φ - side) + np.cos(θ) * math.sin(height)
    glow = 60 * np.exp((sun[..., None] - 1) * 1200) + 0.6 * np.exp((sun[..., None] - 1) * 20)
    return (np.where(up > 0, sky, ground) + glow * np.array([1.0, 0.85, 0.6])).astype(np.float32)


def capture_truth(
    scene: str, data: Path, truth: Path, light: LightConfig, spp: int, resolution: int
) -> None:
    """Render the true scene under the new light, from the held-out cameras.

    Args:
        resolution: pixels along the longer edge.
    """
    dataset = Dataset.load(data)
    # A data set needs a training view; it is not compared.
    views = (dataset.train[0], *dataset.heldout)
    cameras = truth.with_name(f"{scene}-cameras.json")
    frames = []
    for view in views:
        camera = of_size(view.camera, resolution)
        size = {"w": camera.width, "h": camera.height, "fl_x": camera.fl_x}
        pose = {"transform_matrix": camera.to_world.tolist()}
        frames.append({"split": view.split, **size, **pose})
    write_json(cameras, {"frames": frames})
    words = ["--cameras", cameras, "--spp", spp, "--resolution", resolution]
    if light.lights is not None:
        words += ["--lights", light.lights]
    else:
        words += ["--envmap", light.envmap, "--envmap-up", light.envmap_up]
    unbake(
        "capture", scene if scene in ("demo", "still") else dataset.scene, "--out", truth, *words
    )


def described(data: Path, truth: Path) -> dict[str, int]:
    """The photographs of a fit, and the pictures that are compared."""
    photographs, compared = Dataset.load(data), Dataset.load(truth)
    camera = compared.heldout[0].camera
    return {
        "train": len(photographs.train),
        "spp": photographs.render.get("spp", 0),
        "views": len(compared.heldout),
        "width": camera.width,
        "height": camera.height,
        "true_spp": compared.render["spp"],
    }


def measure(
    run: Path, work: Path, light: LightConfig, truth: Path, spp: int
) -> dict[str, float | None]:
    """Scores of a run under its own and under the new light, in dB."""
    out = work / f"{run.name}-relit"
    shutil.rmtree(out, ignore_errors=True)

    def silent(line: str) -> None:
        """Tell nothing."""

    settings = RenderSettings(spp=spp)
    made = relight(run, out, light, settings, truth=truth, tell=silent)
    metrics = evaluate(run, EvaluationSettings(train_views=0), tell=silent)
    keys = ("albedo_psnr", "roughness_psnr", "render_psnr")
    mean = {f"relit_{key}": value for key, value in made["mean"].items() if key != "views"}
    own = {key: metrics["heldout"][key] for key in keys}
    return mean | own | {key: metrics[key] for key in ("steps", "samples", "seconds")}


if __name__ == "__main__":
    main()
