"""A picture of one view for the documentation: the truth and several runs, one row each.

    python scripts/gallery.py --view heldout_000 --out docs/demo.png RUN [RUN ...]

Columns: rendering (or photograph), albedo, roughness. Rows: the truth, then the runs in order.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from unbake import activate
from unbake.imaging.pictures import montage, read_exr, to_bytes, tonemap, write_png


def row(render: Path, albedo: Path, roughness: Path, zoom: int) -> list[np.ndarray]:
    """Three pictures of one view, enlarged without smoothing."""
    grey = np.repeat(read_exr(roughness)[..., :1], 3, -1)
    pictures = [
        tonemap(read_exr(render)[..., :3]),
        tonemap(read_exr(albedo)[..., :3]),
        to_bytes(grey),
    ]
    return [p.repeat(zoom, 0).repeat(zoom, 1) for p in pictures]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--view", default="heldout_000")
    parser.add_argument("--zoom", type=int, default=2)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    activate()
    split = args.view.split("_")[0]
    data = Path(json.loads((args.runs[0] / "evaluation" / "metrics.json").read_text())["data"])
    name = f"{args.view}.exr"
    truth = data / "truth"
    files = [data / "images" / name, truth / "albedo" / name, truth / "roughness" / name]
    rows = [row(*files, args.zoom)]
    for run in args.runs:
        folder = run / "evaluation" / split
        files = [folder / f"{args.view}_{kind}.exr" for kind in ("render", "albedo", "roughness")]
        rows.append(row(*files, args.zoom))
    write_png(args.out, montage(rows))


if __name__ == "__main__":
    main()
