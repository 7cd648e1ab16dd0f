"""Held-out scores of fits with several settings files, over seeds, one fit after the other.

    python benchmarks/variants.py --data DATA [DATA ...] --settings A.toml B.toml --out FILE.json
        [--seeds 0 1 2] [--steps 2400 | --seconds 120] [--methods ours] [--go-on]
        [--also METHOD C.toml]

The fits of a seed follow each other, and the file is written after each fit. With --go-on, fits
that it has already are kept: those of the first seeds, of each data set, method and settings. A fit
of a given time follows one of three steps, which compiles its kernels. Each method has each
settings file; --also adds one method with one more file, in turns with the others.
Scores are PSNRs in dB of linear RGB by `unbake evaluate`, mean over held-out views, with those of
the untrained fields and of the best constants; seconds are those of training.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import tempfile
from itertools import product
from pathlib import Path
from typing import Any

import here

from unbake import backend
from unbake.dataset.views import Dataset
from unbake.errors import UserError
from unbake.experiments.commands import compile_fit, unbake
from unbake.experiments.seeds import across_seeds
from unbake.io import write_json
from unbake.machine import machine
from unbake.training.run_folder import RunFolder

#: What is kept of a fit's scores.
SCORES = ("albedo_psnr", "roughness_psnr", "render_psnr")
LENGTH = ("steps", "samples", "seconds")


def main() -> None:
    """Fit, print every score, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="data sets")
    parser.add_argument("--settings", type=Path, nargs="+", required=True, help="settings files")
    parser.add_argument("--methods", nargs="+", default=["ours"])
    parser.add_argument(
        "--also",
        nargs=2,
        action="append",
        default=[],
        metavar=("METHOD", "SETTINGS"),
        help="a method with settings that the others do not have; may be given several times",
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    length = parser.add_mutually_exclusive_group()
    length.add_argument("--steps", type=int, default=2400)
    length.add_argument("--seconds", type=float, help="of training, instead of steps")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--go-on", action="store_true", help="keep the seeds that the file has")
    args = parser.parse_args()
    backend.activate()
    stop = ("steps", args.steps) if args.seconds is None else ("seconds", args.seconds)
    fits = list(product(args.methods, args.settings))
    fits += [(method, Path(settings)) for method, settings in args.also]
    files = dict.fromkeys(settings for _, settings in fits)
    about = {
        "machine": machine(),
        "length": dict([stop]),
        "data": {data.name: described(data) for data in args.data},
        "settings": {file.stem: file.read_text(encoding="utf-8") for file in files},
    }
    found = started(args.out, about, args.seeds) if args.go_on else {}
    kinds = [(data, *fit) for data, fit in product(args.data, fits)]
    names = [(data.name, method, settings.stem) for data, method, settings in kinds]
    if not found.keys() <= set(names):
        raise SystemExit(f"{args.out} is of other data sets, methods or settings")
    for number, seed in enumerate(args.seeds):
        for name, (data, method, settings) in zip(names, kinds, strict=True):
            runs = found.setdefault(name, [])
            if number < len(runs):
                continue
            runs.append(fit(data, settings, method, seed, stop))
            told = ", ".join(f"{key} {value:.2f}" for key, value in runs[-1].items())
            print(f"{data.name}, {method}, {settings.stem}, seed {seed}: {told}", flush=True)
            seeds = args.seeds[: min(len(found.get(name, [])) for name in names)]
            rows = [
                dict(zip(("data", "method", "settings"), name, strict=True))
                | across_seeds(found[name], found[name][0])
                | {"seeds": args.seeds[: len(found[name])], "runs": found[name]}
                for name in names
                if found.get(name)
            ]
            write_json(args.out, about | {"seeds": seeds, "rows": rows})


def started(
    file: Path, about: dict[str, Any], seeds: list[int]
) -> dict[tuple[str, str, str], list[dict[str, float]]]:
    """The scores of a file, seed by seed: by data, method and settings.

    Args:
        file: has none where it is missing.
        about: what must be the same.
        seeds: the first ones must be those of its rows.
    """
    if not file.is_file():
        return {}
    before = json.loads(file.read_text(encoding="utf-8"))
    for key, value in about.items():
        if before.get(key) != value:
            raise SystemExit(f"{file}: {key}: {before.get(key)} is not {value}")
    for row in before["rows"]:
        of_row = row.get("seeds", before["seeds"])
        if of_row != seeds[: len(row["runs"])]:
            raise SystemExit(f"{file}: a row has the seeds {of_row}")
    return {(r["data"], r["method"], r["settings"]): r["runs"] for r in before["rows"]}


def described(data: Path) -> dict[str, int]:
    """The photographs of a data set: how many there are, their pixels and their samples."""
    dataset = Dataset.load(data)
    width, height = dataset.train[0].camera.width, dataset.train[0].camera.height
    views = {"train": len(dataset.train), "heldout": len(dataset.heldout)}
    return views | {"width": width, "height": height, "spp": dataset.render.get("spp", 0)}


def fit(
    data: Path, settings: Path, method: str, seed: int, stop: tuple[str, float]
) -> dict[str, float]:
    """Scores, steps, samples and seconds of a fit, that stops after so many steps or seconds."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        log = Path(folder) / "log.txt"
        words = ["fit", data, "--out", run, "--settings", settings, "--method", method]
        words += ["--seed", seed, f"--{stop[0]}", stop[1]]
        if stop[0] == "seconds":
            compile_fit(data, "--settings", settings, "--method", method, log=log)
        # A fit that learned nothing fails, and is judged as it is: one that left no run is told by
        # the evaluation.
        with contextlib.suppress(UserError):
            unbake(*words, log=log)
        unbake("evaluate", run, "--train-views", 0, log=log)
        metrics = json.loads(RunFolder(run).metrics_file.read_text(encoding="utf-8"))
    scores = {key: metrics["heldout"][key] for key in SCORES}
    untrained = metrics["yardsticks"]["untrained"]
    constant = metrics["yardsticks"].get("constant", {})
    for name, found in (("untrained", untrained), ("constant", constant)):
        scores |= {f"{name}_{key}": found[key] for key in SCORES if key in found}
    return scores | {key: metrics[key] for key in LENGTH}


if __name__ == "__main__":
    main()
