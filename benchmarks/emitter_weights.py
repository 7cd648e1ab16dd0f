"""How much noise lights that are sampled by what they bring leave, beside lights chosen alike.

    python benchmarks/emitter_weights.py --data DATA [DATA ...] --out FILE.json [--spp 64]

Of each data set whose scene has several lights, pixels of training views are path traced with the
scene's own materials, with light of one bounce alone and of six, twice: with all lights alike, and
with the weights that a fit gives its lights (`transport/emitter_weights.py`). Told is the variance
of a sample in units of the pixel's squared mean, averaged over pixels. Pixels darker than a tenth
of the average count as that.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import here

import mitsuba as mi
import numpy as np

from unbake import backend
from unbake.dataset.pixels import CameraRays
from unbake.dataset.views import Dataset
from unbake.io import write_json
from unbake.machine import machine
from unbake.scene.edit import to_principled
from unbake.scene.parse import parse
from unbake.transport.emitter_weights import RAYS, chosen_alike
from unbake.transport.path_tracer import path_traced
from unbake.transport.render import parts_of
from unbake.transport.vertex import SceneView

#: `max_depth` of paths: one bounce, and six.
DEPTHS = {"direct": 2, "six_bounces": 7}
#: Of the mean of all pixels, what a dark one counts as at least.
_DARK = 0.1


def main() -> None:
    """Measure, print and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, nargs="+", required=True, help="data sets")
    parser.add_argument("--spp", type=int, default=64, help="samples a pixel")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    backend.activate()
    rows = []
    for data in args.data:
        row = measured(Dataset.load(data), args.spp)
        if row is None:
            print(f"{data.name}: there is one light, or its weights are given")
            continue
        rows.append({"data": data.name} | row)
        told = ", ".join(f"{k} {row['alike'][k]:.3g} -> {row['weighed'][k]:.3g}" for k in DEPTHS)
        print(f"{data.name}, {row['lights']} lights: {told}", flush=True)
        write_json(args.out, {"machine": machine(), "spp": args.spp, "rays": RAYS, "rows": rows})


def measured(dataset: Dataset, spp: int) -> dict | None:
    """Variances with lights chosen alike and by weights; None where there is nothing to choose."""
    from unbake.training.problem import weigh_lights  # it needs a variant

    parsed = parse(dataset.scene, dataset.root)
    to_principled(parsed)
    scene = parsed.instantiate()
    if not chosen_alike(scene):
        return None
    view, hidden = SceneView.of(scene, None, 8), dataset.background == "hidden"
    rays = CameraRays.of([shot.camera for shot in dataset.train])
    found = {"lights": len(scene.emitters()), "alike": variances(view, rays, spp, hidden)}
    weigh_lights(view, dataset.train, hide_emitters=hidden)
    weights = sorted(
        (float(mi.traverse(e)["sampling_weight"]) for e in scene.emitters()), reverse=True
    )
    found["chances"] = [round(w / sum(weights), 4) for w in weights]
    return found | {"weighed": variances(view, rays, spp, hidden)}


def variances(view: SceneView, rays: CameraRays, spp: int, hidden: bool) -> dict[str, float]:
    """Relative variances of a sample, by depth."""
    pixels = np.random.default_rng(1).choice(rays.pixels, RAYS, replace=False).astype(np.uint32)

    def through(index: mi.UInt32, offset: mi.Point2f) -> mi.Ray3f:
        return rays.through(mi.UInt32(pixels[np.array(index)]), offset)

    found = {}
    for name, depth in DEPTHS.items():
        squares, means = [], []
        for _, ray, seed in parts_of(through, RAYS, spp, 2):
            light = path_traced(
                view, ray, seed, max_depth=depth, rr_depth=depth, hide_emitters=hidden
            )
            samples = np.array(light, np.float64).mean(axis=0).reshape(-1, spp)
            squares.append(samples.var(axis=1, ddof=1))
            means.append(samples.mean(axis=1))
        mean = np.concatenate(means)
        least = np.maximum(mean, _DARK * mean.mean())
        found[name] = float((np.concatenate(squares) / least**2).mean())
    return found


if __name__ == "__main__":
    main()
