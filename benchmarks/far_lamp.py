"""What a fit makes of a scene with a small lamp that is far away, as a sun.

    python benchmarks/far_lamp.py --data DATA --out FILE.json [--times 1000] [--seeds 0]
        [--steps 600]

A lamp without noticeable light is put so many times as far away as the scene is large: fields then
live in a cube of that size, and photographs are those of before. The data set is fitted with
default settings, without that lamp and with it. Scores are PSNRs in dB of linear RGB by `unbake
evaluate`, mean over held-out views, with those of the untrained fields.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from pathlib import Path

from here import ROOT

from variants import SCORES, described, fit

from unbake import backend
from unbake.dataset.views import Dataset
from unbake.experiments.seeds import across_seeds
from unbake.io import write_json
from unbake.machine import machine
from unbake.scene import free_space
from unbake.scene.parse import parse

#: Radiance of the lamp, and its radius as a part of its distance, that of the sun.
RADIANCE, RADIUS = 1e-3, 4.65e-3
LAMP = """<shape type="sphere">
  <point name="center" x="{0}" y="{1}" z="{2}"/><float name="radius" value="{3}"/>
  <bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>
  <emitter type="area"><rgb name="radiance" value="{4}"/></emitter>
</shape>"""


def main() -> None:
    """Fit, print every score, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="data set")
    parser.add_argument("--times", type=float, default=1000, help="how far away the lamp is")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    backend.activate()
    about = {
        "machine": machine(),
        "length": {"steps": args.steps},
        "data": {args.data.name: described(args.data)},
        "seeds": args.seeds,
        "times": args.times,
    }
    settings, rows = ROOT / "benchmarks" / "rooms" / "defaults.toml", []
    with tempfile.TemporaryDirectory() as folder:
        far = with_lamp(args.data, Path(folder) / "far", args.times)
        for lamp, data in ((False, args.data), (True, far)):
            runs = [fit(data, settings, "ours", s, ("steps", args.steps)) for s in args.seeds]
            rows.append({"lamp": lamp} | across_seeds(runs, runs[0]) | {"runs": runs})
            told = ", ".join(f"{key} {rows[-1][key]:.2f}" for key in SCORES)
            print(f"{'with' if lamp else 'without'} the lamp: {told}", flush=True)
            write_json(args.out, about | {"rows": rows})


def with_lamp(data: Path, folder: Path, times: float) -> Path:
    """A copy of a data set whose scene has the lamp."""
    shutil.copytree(data, folder)
    dataset = Dataset.load(folder)
    _, high, diagonal = free_space.bounds(parse(dataset.scene, dataset.root).instantiate())
    place = [float(x) + times * diagonal / 3**0.5 for x in high]
    text = dataset.scene.read_text(encoding="utf-8")
    lamp = LAMP.format(*place, RADIUS * times * diagonal, RADIANCE)
    dataset.scene.write_text(text.replace("</scene>", f"{lamp}</scene>"), encoding="utf-8")
    return folder


if __name__ == "__main__":
    main()
