"""What faults of cameras cost, and what fitting the cameras gives back.

    python benchmarks/cameras.py --data DATA --out FILE.json [--faults NAME ...]
        [--cameras known fitted] [--seeds 0] [--steps 2400] [--batch 1024] [--spp 8]

A rendered data set is fitted as it is, and then after `unbake degrade`, fault by fault: taken for
known, and with what is unknown of the cameras fitted. `FAULTS` says what each one is. Scores are
PSNRs in dB of linear RGB by `unbake evaluate`, mean over held-out views. Errors of what was found
of the cameras, against the truth that `degrade` keeps:

- `stops_error_*`: of the exposures of training views but the first, which is the anchor;
- `balance_error_*`: of red and blue relative to green, of the same views, in stops;
- `vignetting_error_most`: over the picture, as a share of the light;
- `response_error_*`: of what the curve makes of code values, as a share of white; and
  `response_scaled_error_*` after the scale `response_scale`, common to all channels: a fit fixes
  its curve in the middle of the code values; where the true one is different there, so is all
  light;
- `train_pixels` and `heldout_pixels`: of the poses that the fit ended with, root mean square in the
  image over pixels and views, as in `poses.py`; where poses were taken as given, of these.

`true_*` are scores of materials as the true cameras see them: where poses are off, the others
compare maps that are moved against each other. Any rendered data set will do, rooms as well.

Rows that FILE has of the same data and options are kept: a run that was stopped goes on, on another
machine, too. Fits have a number of steps, so that scores are the same on all; `machine` of a row is
the one that took its seconds, and `made` the day. Rows of different versions do not compare: remove
those of before a change that matters, or write another FILE.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import here

import numpy as np
from variants import SCORES

from unbake import backend
from unbake.acquisition.degrade import degrade
from unbake.acquisition.settings import DegradeSettings
from unbake.dataset.data_folder import DataFolder
from unbake.dataset.views import Dataset
from unbake.evaluation.settings import EvaluationSettings
from unbake.experiments.commands import unbake
from unbake.experiments.seeds import across_seeds
from unbake.io import write_json
from unbake.machine import machine, today

LENGTH = ("samples", "seconds")
#: Of a measurement, all of which rows have in common.
OPTIONS = ("seeds", "steps", "batch", "fit_spp")
#: How faults are fitted.
CAMERAS = ("known", "fitted")
#: What matters here is material: pictures have few samples, which costs all rows the same.
EVALUATION = EvaluationSettings(spp=4, train_views=0)
#: Curves of responses are even in code values of this power, as `fields/camera.py` has them.
GAMMA = 2.2


@dataclass(frozen=True)
class Fault:
    """What `degrade` does, and the options of a fit that knows of it."""

    settings: Mapping[str, Any]
    words: tuple[str, ...] = ()


EXPOSURE = Fault({"exposure": 1.5}, ("--exposures", "per-image"))
BALANCE = Fault({"white_balance": 1.0}, ("--white-balance", "per-image"))
VIGNETTING = Fault({"vignetting": 0.4}, ("--vignetting", "radial"))
SENSOR = Fault({"electrons": 10000.0, "read_noise": 5.0})
CODES, COMPRESSED = Fault({"format": "png"}), Fault({"format": "jpeg"})
FULL_CHROMA = Fault({"format": "jpeg", "chroma": "full"})
MESH = Fault({"decimate": 0.1})
NOISE = Fault({"electrons": 200.0, "read_noise": 4.0})
CONTRAST = Fault({"response": "contrast"}, ("--response", "monotone"))
LIFTED = Fault({"response": "lifted"}, ("--response", "monotone"))
POSES = Fault({"pose_jitter": 1.0}, ("--poses", "refined"))


def together(*faults: Fault) -> Fault:
    """Several faults at once."""
    settings = {key: value for fault in faults for key, value in fault.settings.items()}
    return Fault(settings, tuple(word for fault in faults for word in fault.words))


JPEG = together(COMPRESSED, SENSOR)
ALL_BUT_MESH = together(BALANCE, VIGNETTING, CONTRAST, JPEG, POSES)
#: As EXIF does.
TOLD = Fault({"exposure": 1.5, "tell_exposures": True})

FAULTS = {
    "exposure": EXPOSURE,
    "white balance": BALANCE,
    "vignetting": VIGNETTING,
    "response": CONTRAST,
    "response, exposures told": together(CONTRAST, TOLD),
    "response and exposure": together(CONTRAST, EXPOSURE),
    "jpeg": JPEG,
    "jpeg, its noise alone": SENSOR,
    "jpeg, 8 bits alone": CODES,
    "jpeg, without noise": COMPRESSED,
    "jpeg, without noise, colour at full resolution": FULL_CHROMA,
    "noise": NOISE,
    "noise, told": together(NOISE, Fault({"tell_noise": True})),
    "mesh": MESH,
    "mesh, outliers found": together(MESH, Fault({}, ("--outliers", "found"))),
    "poses": POSES,
    "response off centre, exposures told": together(LIFTED, TOLD),
    "all but mesh, exposures told": together(ALL_BUT_MESH, TOLD),
    "all but mesh": together(ALL_BUT_MESH, EXPOSURE),
    "all, exposures told": together(ALL_BUT_MESH, MESH, TOLD),
    "all": together(ALL_BUT_MESH, MESH, EXPOSURE),
}

#: In which rows stand.
ORDER = ["none", *FAULTS]


def main() -> None:
    """Fit, print every score, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="data set")
    parser.add_argument("--faults", nargs="+", choices=FAULTS, default=list(FAULTS))
    parser.add_argument("--cameras", nargs="+", choices=CAMERAS, default=list(CAMERAS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--steps", type=int, default=2400)
    parser.add_argument("--batch", type=int, default=1024, help="pixels in a step")
    parser.add_argument(
        "--spp", type=int, default=8, dest="fit_spp", help="samples a pixel in a step"
    )
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    backend.activate()
    result = about(args)
    rows: list[dict[str, Any]] = kept(args.out, result)
    options = ["--steps", args.steps, "--batch", args.batch, "--spp", args.fit_spp]
    known = {(row["fault"], row["cameras"]) for row in rows}
    for fault, fit in [("none", "known")] + [(f, c) for f in args.faults for c in args.cameras]:
        if (fault, fit) in known or (fit == "fitted" and not FAULTS[fault].words):
            continue
        found = [scores(args.data, fault, fit, seed, options) for seed in args.seeds]
        row = {"fault": fault, "cameras": fit} | across_seeds(found, found[0])
        row |= {"machine": result["machine"], "made": today()}
        rows.append(row)
        known.add((fault, fit))
        told = ", ".join(f"{k} {v:.3f}" for k, v in row.items() if isinstance(v, float))
        print(f"{fault}, {fit}: {told}", flush=True)
        rows.sort(key=lambda row: (ORDER.index(row["fault"]), CAMERAS.index(row["cameras"])))
        write_json(args.out, result | {"rows": rows})


def about(args: argparse.Namespace) -> dict[str, Any]:
    """What the rows of a result have in common."""
    return {
        "machine": machine(),
        **about_data(args.data),
        **{key: getattr(args, key) for key in OPTIONS},
        "faults": {name: dict(fault.settings) for name, fault in FAULTS.items()},
    }


def about_data(data: Path) -> dict[str, Any]:
    """Name and size of a data set."""
    dataset = Dataset.load(data)
    camera = dataset.train[0].camera
    return {
        "data": data.name,
        "train": len(dataset.train),
        "heldout": len(dataset.heldout),
        "width": camera.width,
        "height": camera.height,
        "spp": dataset.render.get("spp", 0),
    }


def kept(file: Path, result: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The rows of a file that measured the same."""
    if not file.is_file():
        return []
    old = json.loads(file.read_text(encoding="utf-8"))
    same = all(old.get(key) == result[key] for key in ("data", *OPTIONS))
    faults = old.get("faults", {})
    return [
        {"machine": old["machine"]} | row
        for row in old["rows"]
        if same and faults.get(row["fault"]) == result["faults"].get(row["fault"])
    ]


def scores(
    data: Path, fault: str, cameras: str, seed: int, options: Sequence[object]
) -> dict[str, float]:
    """Scores of a fit, and errors of what it found of the cameras."""
    clean = Dataset.load(data)
    with tempfile.TemporaryDirectory() as folder:
        run, words = Path(folder) / "run", ["--seed", seed, *options]
        if fault != "none":
            worse = Path(folder) / "data"
            degrade(data, worse, DegradeSettings(**FAULTS[fault].settings, seed=seed))
            words += FAULTS[fault].words if cameras == "fitted" else ()
            data = worse
        log = Path(folder) / "log.txt"
        unbake("fit", data, "--out", run, *words, log=log)
        from poses import at_true_cameras  # these need the variant

        from unbake.evaluation.evaluate import evaluate

        metrics = evaluate(run, EVALUATION, tell=lambda line: None)
        found = {key: metrics["heldout"][key] for key in SCORES}
        found |= at_true_cameras(run, clean)
        if metrics.get("camera"):
            truth = json.loads(DataFolder(data).degraded_file.read_text(encoding="utf-8"))
            found |= errors(metrics["camera"], truth)
        return found | {key: metrics[key] for key in LENGTH}


def errors(camera: Mapping[str, Any], truth: Mapping[str, Any]) -> dict[str, float]:
    """Errors of what was found of the cameras."""
    found: dict[str, float] = {}
    images = [row for row in camera.get("images", ()) if row["split"] == "train"]
    images = [row for row in images if row["name"] != camera.get("anchor")]
    true = [truth["views"][row["name"]] for row in images]
    if images and truth["settings"]["exposure"] and not truth["settings"]["tell_exposures"]:
        ratios = [
            row["exposure"] / view["exposure"] for row, view in zip(images, true, strict=True)
        ]
        found |= spread("stops_error", np.log2(ratios))
    if images and "red" in images[0]:
        ratios = np.array([[row["red"], row["blue"]] for row in images])
        balance = np.array([view["white_balance"] for view in true])
        balance = balance[:, [0, 2]] / balance[:, [1]]
        found |= spread("balance_error", np.log2(ratios / balance))
    if terms := camera.get("vignetting"):
        square = np.linspace(0, 1, 65)
        falloff = 1 + square * (terms["a"] + square * (terms["b"] + square * terms["c"]))
        wrong = falloff - (1 - truth["settings"]["vignetting"] * square)
        found["vignetting_error_most"] = float(np.abs(wrong).max())
    if curves := camera.get("response"):
        curve = np.array([curves[channel] for channel in ("red", "green", "blue")])
        light = true_light(truth, curve.shape[1])
        found |= spread("response_error", curve**GAMMA - light)
        scale = float((curve**GAMMA * light).sum() / (curve ** (2 * GAMMA)).sum())
        found |= spread("response_scaled_error", scale * curve**GAMMA - light)
        found["response_scale"] = scale
    return found


def true_light(truth: Mapping[str, Any], places: int) -> np.ndarray:
    """The light of photographs at even places of code values, by what `degrade` keeps."""
    read, linear = (np.array(truth["response"][key]) for key in ("read", "linear"))
    return np.interp(np.linspace(0, 1, places) ** GAMMA, read, linear)


def spread(name: str, wrong: np.ndarray) -> dict[str, float]:
    """Root mean square, mean and greatest size of errors."""
    return {
        f"{name}_rms": float(np.sqrt(np.mean(np.square(wrong)))),
        f"{name}_mean": float(np.mean(wrong)),
        f"{name}_most": float(np.abs(wrong).max()),
    }


if __name__ == "__main__":
    main()
