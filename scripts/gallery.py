"""A picture of one view for the documentation: the truth and several runs, one row each.

    python scripts/gallery.py --view heldout_000 --out docs/demo.png RUN [RUN ...]

Columns: rendering (or photograph), albedo, roughness. Rows: the truth, then the runs in order.
"""

import argparse
from pathlib import Path

import numpy as np

from unbake import activate
from unbake.dataset.data_folder import DataFolder
from unbake.imaging.pictures import montage, read_exr, to_bytes, tonemap, write_png
from unbake.training.run_folder import RunFolder


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
    """Write the picture that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--view", default="heldout_000")
    parser.add_argument("--zoom", type=int, default=2)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    activate()
    split = args.view.split("_")[0]
    runs = [RunFolder(path) for path in args.runs]
    data = DataFolder(runs[0].data(runs[0].metrics()["data"]))
    truth = [data.truth(quantity, args.view) for quantity in ("albedo", "roughness")]
    rows = [row(data.image(args.view), *truth, args.zoom)]
    for run in runs:
        kinds = ("render", "albedo", "roughness")
        rows.append(row(*(run.picture(split, args.view, kind) for kind in kinds), args.zoom))
    write_png(args.out, montage(rows))


if __name__ == "__main__":
    main()
