"""Lamps of rooms that nobody knows: how they are found, and what materials cost without them.

    python benchmarks/lamps.py --data DATA [DATA ...] --out FILE.json [--fit NAME ...]
        [--runs FOLDER] [--seeds 0] [--steps 1200]

Data sets of `unbake capture` with lamps that are shapes. Of each, by photographs as they are and
clipped at 1:

- `lamps`: area lights of the scene; `found`: those that are found, of which half of the triangles
  are; `wrong`: found ones that are none;
- `error_most`: of what is found, |c - c*| / |c*| of linear RGB, where photographs are not clipped.

Data sets of `--fit` are fitted in four ways, PSNR in dB of linear RGB of materials as the held-out
views see them; `aligned` is albedo after the factors of its channels that suit it best:

- `known`: lights as the scene has them;
- `unknown`: `--unknown materials+emission`, the shapes of lamps are known;
- `found`: photographs and meshes alone, imported as from nerfstudio (OpenEXR); the import finds the
  lamps. Other materials than principled ones are not told, and are fitted as such;
- `found, clipped`: the same of PNG of 8 bits, clipped at 1.

What FOLDER has already is not made again.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import here

import numpy as np
from poses import SAMPLES, as_seen, fit  # activates a variant

from unbake.dataset.data_folder import TRANSFORMS
from unbake.dataset.views import Dataset, read_photograph
from unbake.experiments.seeds import across_seeds
from unbake.exports.parts import read_parts
from unbake.imaging.coded import encode
from unbake.imaging.pictures import write_exr, write_png
from unbake.importing import lamps as finding
from unbake.importing.import_data import import_data
from unbake.importing.lamps import find_lamps
from unbake.importing.meshes import Part
from unbake.io import write_json
from unbake.machine import machine, today
from unbake.quantities import ALIGNED
from unbake.scene.emitters import emitter_nodes, named_emitters
from unbake.training.recovered import Recovered, load_run
from unbake.training.run_folder import RunFolder
from unbake.training.validation import GroundTruth, MaterialBuffers, albedos, aligned

#: Value from which on photographs are clipped.
LIMIT = 1.0


def main() -> None:
    """Find, fit, print every row, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, nargs="+", required=True)
    parser.add_argument("--fit", nargs="*", default=[], help="names of data sets to fit")
    parser.add_argument("--runs", type=Path, help="folder for data sets and runs")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--steps", type=int, default=1200)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        runs = args.runs or Path(scratch)
        found, fits = [], []
        for folder in args.data:
            captured = Dataset.load(folder)
            for clipped in (False, True):
                found.append(
                    {"data": folder.name, "clipped": clipped} | judged(captured, clipped=clipped)
                )
                print(found[-1], flush=True)
            if folder.name in args.fit:
                fits += fitted(captured, runs, args.seeds, args.steps)
        about = {"machine": machine(), "made": today(), "limit": LIMIT}
        more = {"seeds": args.seeds, "steps": args.steps, "fits": fits}
        write_json(args.out, about | {"found": found} | more)


def parts_of(captured: Dataset) -> tuple[list[Part], dict[int, np.ndarray]]:
    """The triangles of a data set, by shape, as another program has them.

    Also the radiance of those that are area lights, linear RGB, by their number.
    """
    shapes = read_parts(captured.scene, captured.root)
    named = named_emitters(shapes.scene)
    strengths = dict(zip(emitter_nodes(shapes.scene), named, strict=True))
    parts, lamps = [], {}
    for number, shape in enumerate(shapes.parts):
        corners = np.asarray(shape.triangles.positions, np.float64)
        parts.append(Part(shape.name, corners, np.asarray(shape.triangles.faces), None, None))
        if shape.emitter is not None and strengths[shape.emitter].strength is not None:
            lamps[number] = np.array(strengths[shape.emitter].strength)
    return parts, lamps


def judged(captured: Dataset, *, clipped: bool) -> dict[str, Any]:
    """What is found of the lamps of a data set."""
    parts, true = parts_of(captured)
    views, read = captured.train, finding.read_photograph
    if clipped:
        views = [replace(view, clipped=LIMIT) for view in views]
        finding.read_photograph = lambda view: np.minimum(read(view), LIMIT)
    try:
        lamps = find_lamps(parts, views, print)
    finally:
        finding.read_photograph = read
    right = [lamp for lamp in lamps if lamp.part in true]
    whole = {x.part for x in right if len(x.faces) > 0.5 * len(parts[x.part].faces)}
    errors = [_error(lamp.radiance, true[lamp.part]) for lamp in right if not lamp.clipped]
    return {
        "triangles": sum(len(part.faces) for part in parts),
        "lamps": len(true),
        "found": len(whole),
        "wrong": len(lamps) - len(right),
        "error_most": max(errors, default=None),
    }


def _error(found: Sequence[float], true: np.ndarray) -> float:
    return float(np.linalg.norm(np.array(found) - true) / np.linalg.norm(true))


def fitted(captured: Dataset, runs: Path, seeds: list[int], steps: int) -> list[dict[str, Any]]:
    """Rows of scores: with known lamps, with unknown ones, and with none."""
    data = captured.folder
    foreign = {
        way: imported(captured, runs / f"{data.name}-{way.replace(', ', '-')}", clipped=clipped)
        for way, clipped in (("found", False), ("found, clipped", True))
    }
    unknown = {"known": "materials", "unknown": "materials+emission"}
    rows = []
    for way, folder in {"known": data, "unknown": data, **foreign}.items():
        found = []
        for seed in seeds:
            run = runs / f"run-{data.name}-{way.replace(', ', '-')}-{seed}"
            fit(folder, run, ["--unknown", unknown.get(way, "auto"), "--seed", seed,
                              "--steps", steps])  # fmt: skip
            scores = as_seen(load_run(run), captured) | aligned_albedo(load_run(run), captured)
            found.append(scores | {"seconds": RunFolder(run).metrics()["seconds"]})
        rows.append({"data": data.name, "way": way} | across_seeds(found, found[0]))
        print(rows[-1], flush=True)
    return rows


def aligned_albedo(recovered: Recovered, captured: Dataset) -> dict[str, float]:
    """The score of albedo after the factors of its channels that suit it best."""
    seen = MaterialBuffers.of(recovered.problem, captured.heldout, SAMPLES, 0)
    truths = [GroundTruth.of(view) for view in captured.heldout]
    _, scores = aligned([albedos(s, t) for s, t in zip(seen, truths, strict=True)])
    return {ALIGNED: float(np.mean([score for score in scores if score is not None]))}


def imported(captured: Dataset, folder: Path, *, clipped: bool) -> Path:
    """Write photographs and meshes as for nerfstudio, and import them; returns the data set."""
    source, out = folder / "source", folder / "data"
    if out.is_dir():
        return out
    meshes = []
    for part in parts_of(captured)[0]:
        meshes.append(folder / f"{part.name}.ply")
        meshes[-1].parent.mkdir(parents=True, exist_ok=True)
        part.write(meshes[-1])
    frames, held = [], []
    for view in captured.views:
        rgb, name = read_photograph(view)[..., :3], f"{view.name}.{'png' if clipped else 'exr'}"
        file = source / name
        file.parent.mkdir(parents=True, exist_ok=True)
        if clipped:
            codes = np.round(encode(np.minimum(rgb, LIMIT)) / 257)
            write_png(file, codes.astype(np.uint8))
        else:
            write_exr(file, rgb)
        camera = view.camera
        keys = ("fl_x", "fl_y", "cx", "cy")
        frame = {key: getattr(camera, key) for key in keys} | {"w": camera.width}
        frame |= {"h": camera.height, "transform_matrix": camera.to_world.tolist()}
        frames.append(frame | {"file_path": name})
        held.extend([name] if view.split == "heldout" else [])
    rest = [frame["file_path"] for frame in frames if frame["file_path"] not in held]
    top = {"frames": frames, "train_filenames": rest, "test_filenames": held}
    (source / TRANSFORMS).write_text(json.dumps(top))
    import_data(source, out, meshes, tell=print)
    return out


if __name__ == "__main__":
    main()
