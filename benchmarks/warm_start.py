"""What a solved radiance field is worth before a fit, and after it, under other light.

    python benchmarks/warm_start.py --work FOLDER --out FILE.json [--data DATA] [--steps 400]
        [--starts cold guess true] [--batch 512] [--spp 4] [--solve-steps 300]
        [--tune-steps 400] [--resolution 64] [--reference-spp 128]

Fits of the same data set and seed start their radiance field untrained (`cold`), as solved for the
materials of untrained fields (`guess`), or as solved for the true materials (`true`), which no user
has. Scores are of held-out views. Then the field of the cold run is learned on under two lamps that
no photograph showed, and compared with `relight` of the same run, in CPU seconds. What is done in
the folder is kept: data set, runs, solved fields, pictures.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import here

import numpy as np

from unbake import backend

backend.activate()

from relight_demo import LAMPS, lamps  # noqa: E402

from unbake.acquisition.new_light import change_light  # noqa: E402
from unbake.config import preset  # noqa: E402
from unbake.config.light import LightConfig  # noqa: E402
from unbake.dataset.camera import Camera  # noqa: E402
from unbake.dataset.camera_files import frame_of  # noqa: E402
from unbake.dataset.data_folder import TRANSFORMS  # noqa: E402
from unbake.dataset.views import Dataset  # noqa: E402
from unbake.evaluation.convergence import score_curve  # noqa: E402
from unbake.evaluation.renderings import render_camera  # noqa: E402
from unbake.evaluation.settings import RenderSettings  # noqa: E402
from unbake.experiments.commands import unbake  # noqa: E402
from unbake.imaging.pictures import read_exr  # noqa: E402
from unbake.io import read_object, write_json, write_text  # noqa: E402
from unbake.machine import machine  # noqa: E402
from unbake.solver.pictures import relative_mse  # noqa: E402
from unbake.solver.settings import SolveSettings  # noqa: E402
from unbake.solver.solve import fine_tune, solve  # noqa: E402
from unbake.training.loop import fit  # noqa: E402
from unbake.training.recovered import load_run  # noqa: E402
from unbake.training.run_folder import RunFolder  # noqa: E402

#: What fits start with.
STARTS = ("cold", "guess", "true")
#: Shares of a fit after which scores are compared.
SHARES = (0.0, 0.25, 0.5, 1.0)
#: Samples a pixel of relit pictures.
SAMPLES = (1, 2, 4, 8, 16, 32, 64)


def main() -> None:
    """Fit, solve and relight; print and write every number as it is found."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--work", type=Path, required=True, help="folder of runs and fields")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--data", type=Path, help="data set (default: a capture of demo)")
    parser.add_argument("--starts", nargs="+", choices=STARTS, default=STARTS)
    parser.add_argument("--steps", type=int, default=400, help="of a fit")
    parser.add_argument("--batch", type=int, default=512)
    parser.add_argument("--spp", type=int, default=4)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--score-seconds", type=float, default=5.0)
    parser.add_argument("--solve-steps", type=int, default=300)
    parser.add_argument("--tune-steps", type=int, default=400)
    parser.add_argument("--resolution", type=int, default=64, help="of pictures under other light")
    parser.add_argument("--reference-spp", type=int, default=128)
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    data = args.data or args.work / "data"
    if not data.exists():
        unbake("capture", "demo", "--out", data, "--resolution", 64)
    found: dict[str, Any] = {
        "machine": machine(),
        "settings": {
            k: v for k, v in vars(args).items() if k not in ("work", "out", "data", "starts")
        },
        "data": described(data),
        "fits": {},
    }
    for start in args.starts:
        row = kept(args.work / f"{start}.json", lambda start=start: fitted(start, data, args))
        row["after"] = [at_step(row["scores"], args.steps * share) for share in SHARES]
        found["fits"][start] = row
        write_json(args.out, found, allow_nan=False)
        last = row["scores"][-1]
        told = ", ".join(f"{k} {v:.2f}" for k, v in last.items() if k.endswith("psnr"))
        print(f"{start}: {told}, {row['cpu_seconds']:.0f} CPU s", flush=True)
    write_text(args.work / "lamps.xml", lamps(LAMPS))
    light = LightConfig(lights=args.work / "lamps.xml")
    run = args.work / "run-cold"
    found["tuned"] = kept(args.work / "tuned.json", lambda: tuned(run, light, args))
    write_json(args.out, found, allow_nan=False)
    found["relit"] = kept(args.work / "relit.json", lambda: relit(run, light, args))
    write_json(args.out, found, allow_nan=False)
    for row in found["tuned"]["measurements"]:
        side = row["relmse_debiased"]
        print(f"tuned {row['cpu_seconds']:.1f} CPU s: LHS {side['lhs']:.4f}, RHS {side['rhs']:.4f}")
    for row in found["relit"]:
        print(f"relit {row['spp']} samples, {row['cpu_seconds']:.2f} CPU s: {row['relmse']:.4f}")


def kept(file: Path, make: Callable[[], Any]) -> Any:
    """What a file holds; it is made where it does not exist."""
    if not file.exists():
        write_json(file, {"found": make()}, allow_nan=False)
    return read_object(file)["found"]


def described(data: Path) -> dict[str, Any]:
    """The data set."""
    dataset = Dataset.load(data)
    camera = dataset.heldout[0].camera
    counts = {"views": len(dataset.train), "heldout": len(dataset.heldout)}
    return counts | {"width": camera.width, "height": camera.height}


def fitted(start: str, data: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Scores over the steps of a fit, and the CPU seconds that it and its solve took."""
    solved = None
    row: dict[str, Any] = {"solve": None}
    if start != "cold":
        solved = args.work / f"solved-{start}"
        row["solve"] = solved_for(start, data, solved, args)
    config = replace(
        preset("cpu"),
        steps=args.steps,
        pixels=args.batch,
        spp=args.spp,
        seed=args.seed,
        score_seconds=args.score_seconds,
    )
    run = args.work / f"run-{start}"
    begun = time.process_time()
    fit(data, run, config, radiance_from=solved)
    spent = time.process_time() - begun
    keys = ("step", "albedo_psnr", "roughness_psnr")
    scores = [{k: point[k] for k in keys} for point in score_curve(RunFolder(run).log())]
    return row | {"cpu_seconds": round(spent, 1), "scores": scores}


def at_step(scores: list[dict[str, Any]], step: float) -> dict[str, float]:
    """The scores at a step, interpolated linearly between those that were taken."""
    steps = [point["step"] for point in scores]
    keys = [key for key in scores[0] if key != "step"]
    found = {key: float(np.interp(step, steps, [p[key] for p in scores])) for key in keys}
    return {"step": round(step)} | found


def solved_for(start: str, data: Path, out: Path, args: argparse.Namespace) -> dict[str, Any]:
    """Solve for a guess of the materials or the true ones; what it cost, and how good it is."""
    settings = SolveSettings(
        steps=args.solve_steps, reference_spp=0, spp=1, final_spp=1, seed=args.seed, views=24
    )
    if start == "guess":
        guess = args.work / "run-untrained"
        if not guess.exists():
            fit(data, guess, replace(preset("cpu"), steps=0, seed=args.seed))
        made = fine_tune(guess, out, settings, tell=silent)
    else:
        # Its cameras are those of the photographs, which tell the size of the field.
        cameras = data / TRANSFORMS
        made = solve(Dataset.load(data).scene, out, settings, cameras=cameras, tell=silent)
    last = made["measurements"][-1]
    return {"steps": last["step"], "cpu_seconds": last["cpu_seconds"]}


def cameras(run: Path) -> list[Camera]:
    """The held-out cameras of a run, which are square in `demo`."""
    folder = RunFolder(run)
    return [view.camera for view in Dataset.load(folder.data(folder.origin().data)).heldout]


def tuned(run: Path, light: LightConfig, args: argparse.Namespace) -> dict[str, Any]:
    """The field of the run learned on under the light, measured on the way."""
    settings = SolveSettings(
        steps=args.tune_steps, reference_spp=args.reference_spp, spp=16, final_spp=64,
        seed=args.seed, max_depth=48, rr_depth=5,
    )  # fmt: skip
    small = [camera.rescaled(args.resolution, args.resolution) for camera in cameras(run)]
    file = args.work / "cameras.json"
    write_json(file, {"frames": [frame_of(camera) | {"split": "heldout"} for camera in small]})
    made = fine_tune(run, args.work / "tuned", settings, light=light, cameras=file, tell=silent)
    keys = ("views", "reference_noise", "measurements")
    return {key: made[key] for key in keys}


def relit(run: Path, light: LightConfig, args: argparse.Namespace) -> list[dict[str, Any]]:
    """Path traced pictures of the same views, as `relight` makes them, with more and more samples.

    Compared with the reference of `tuned`, whose noise is subtracted.
    """
    made = read_object(args.work / "tuned" / "solve.json")
    reference = [read_exr(args.work / "tuned" / f"{name}-reference.exr") for name in made["views"]]
    change = partial(change_light, light=light, allow_outside=False, tell=silent)
    recovered = load_run(run, change=change)
    problem = recovered.problem
    small = [camera.rescaled(args.resolution, args.resolution) for camera in cameras(run)]
    rows = []
    for spp in (SAMPLES[-1], *SAMPLES):  # the first time compiles
        before, settings = time.process_time(), RenderSettings(spp=spp)
        pictures = [
            render_camera(problem.scene_view, camera, settings, problem.hide_emitters, 100 + i)
            for i, camera in enumerate(small)
        ]
        spent = time.process_time() - before
        error = relative_mse(pictures, reference) - made["reference_noise"]
        rows.append({"spp": spp, "cpu_seconds": round(spent, 2), "relmse": error})
    return rows[1:]


def silent(line: str) -> None:
    """Tell nothing."""


if __name__ == "__main__":
    main()
