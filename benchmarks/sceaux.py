"""What a fit makes of real photographs: ten of Sceaux Castle, with COLMAP's cameras and a mesh.

    python benchmarks/sceaux.py --source sceaux --out FILE.json [--edge 256] [--steps 300]

The source is a COLMAP project with `images`, `sparse`, `mesh.ply` and EXIF in the photographs. They
are made smaller first, averaged in linear light. Then follow one `unbake import` and fits of
materials and light: exposures as EXIF tells them, and fitted with a white balance for each
photograph, which begins without EXIF. There are no true materials. Told are:

- the PSNR of photographs that were held out, on the mesh, after their own exposure where it is
  fitted: linear values as the file has them, at most as bright as it can be;
- exposures that were fitted against those of EXIF, in stops, without their mean;
- the mean albedo of what held-out photographs see, and the share of it at its upper bound.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import here

import numpy as np
from PIL import Image

from unbake import backend
from unbake.dataset.data_folder import DataFolder
from unbake.dataset.views import Dataset, read_photograph
from unbake.evaluation.settings import EvaluationSettings
from unbake.experiments.commands import unbake
from unbake.imaging.coded import decode, encode, read_codes
from unbake.imaging.pictures import read_exr
from unbake.io import write_json
from unbake.machine import machine
from unbake.training.run_folder import RunFolder

#: The folder of photographs of a project.
IMAGES = "images"
FITTED = ("--exposures", "per-image", "--white-balance", "per-image")
#: Pictures have few samples.
EVALUATION = EvaluationSettings(spp=8, train_views=0)
#: Albedo from which on it counts as white.
WHITE = 0.9


def main() -> None:
    """Import, fit, print every score, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--source", type=Path, required=True, help="COLMAP project")
    parser.add_argument("--edge", type=int, default=256, help="width of the photographs, pixels")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--batch", type=int, default=1024, help="pixels in a step")
    parser.add_argument("--spp", type=int, default=8, help="samples a pixel in a step")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    backend.activate()
    from unbake.evaluation.evaluate import evaluate  # needs the variant

    options = ["--steps", args.steps, "--batch", args.batch, "--spp", args.spp]
    options += ["--unknown", "materials+lighting"]
    about: dict[str, Any] = {"machine": machine(), "data": args.source.name}
    about |= {key: getattr(args, key) for key in ("edge", "steps", "batch", "spp")}
    with tempfile.TemporaryDirectory() as folder:
        project, log = Path(folder) / "project", Path(folder) / "log.txt"
        smaller(args.source, project, args.edge)
        data, untold = Path(folder) / "data", Path(folder) / "untold"
        mesh = args.source / "mesh.ply"
        unbake("import", project, "--mesh", mesh, "--background", "hidden", "--out", data, log=log)
        exif = without_exposures(data, untold)
        rows = []
        for name, photographs, words in (("known", data, ()), ("fitted", untold, FITTED)):
            run = Path(folder) / name
            unbake("fit", photographs, "--out", run, *options, *words, log=log)
            metrics = evaluate(run, EVALUATION, tell=lambda line: None)
            rows.append({"cameras": name} | scores(photographs, run, metrics, exif))
            print(rows[-1], flush=True)
            write_json(args.out, about | {"rows": rows})


def smaller(source: Path, project: Path, edge: int) -> None:
    """The project with photographs that are `edge` pixels wide, as PNG with their EXIF."""
    lines = (source / "sparse" / "cameras.txt").read_text(encoding="utf-8").splitlines()
    cameras = [line.split() for line in lines if line.strip() and not line.startswith("#")]
    if len(cameras) != 1 or cameras[0][1] not in ("PINHOLE", "SIMPLE_PINHOLE"):
        told = ", ".join(camera[1] for camera in cameras)
        raise SystemExit(f"{source} has the cameras {told or 'none'}, not a single pinhole")
    (camera,) = cameras
    width, height = int(camera[2]), int(camera[3])
    factor = width // edge
    if factor * edge != width:
        raise SystemExit(f"--edge {edge} does not divide {width}")
    size = [edge, height // factor]
    numbers = [float(value) / factor for value in camera[4:]]
    (project / IMAGES).mkdir(parents=True)
    shutil.copytree(source / "sparse", project / "sparse")
    told = " ".join(map(str, [camera[0], camera[1], *size, *numbers]))
    (project / "sparse" / "cameras.txt").write_text(told + "\n", encoding="utf-8")
    for file in sorted((source / IMAGES).iterdir()):
        light = decode(read_codes(file))[: size[1] * factor, :, :3]
        light = light.reshape(size[1], factor, edge, factor, 3).mean((1, 3))
        codes = np.round(encode(light) / 257).astype(np.uint8)
        with Image.open(file) as opened:
            exif = opened.getexif()
        Image.fromarray(codes).save(project / IMAGES / f"{file.stem}.png", exif=exif)
    images = project / "sparse" / "images.txt"
    images.write_text(images.read_text(encoding="utf-8").replace(".jpg", ".png"), encoding="utf-8")


def without_exposures(data: Path, out: Path) -> dict[str, float]:
    """A copy of a data set that does not tell its exposures, and these by view."""
    shutil.copytree(data, out)
    content = DataFolder(out).read_transforms()
    told = {}
    for frame in content["frames"]:
        told[Path(frame["file_path"]).stem] = frame.pop("exposure")
    DataFolder(out).write_transforms(content)
    return told


def scores(
    data: Path, run: Path, metrics: dict[str, Any], exif: dict[str, float]
) -> dict[str, Any]:
    """What is told of a fit."""
    found = {key: metrics[key] for key in ("steps", "samples", "seconds")}
    found["render_psnr"] = metrics["heldout"]["render_psnr"]
    if camera := metrics.get("camera"):
        rows = [row for row in camera["images"] if row["split"] == "train"]
        stops = np.array([[row["stops"], np.log2(exif[row["name"]])] for row in rows])
        stops -= stops.mean(0)
        found["stops_error_rms"] = float(np.sqrt(np.mean((stops[:, 0] - stops[:, 1]) ** 2)))
        found["stops_correlation"] = float(np.corrcoef(stops.T)[0, 1])
        found["stops"] = {
            row["name"]: list(pair) for row, pair in zip(rows, stops.tolist(), strict=True)
        }
    albedo = seen_albedo(data, run)
    found["albedo_mean"] = albedo.mean(0).tolist()
    found["albedo_white"] = float((albedo > WHITE).mean())
    return found


def seen_albedo(data: Path, run: Path) -> np.ndarray:
    """Albedo at the pixels of held-out photographs that count, (n, 3)."""
    found: Sequence[np.ndarray] = [
        read_exr(RunFolder(run).picture("heldout", view.name, "albedo"))[
            read_photograph(view)[..., 3] > 0, :3
        ]
        for view in Dataset.load(data).heldout
    ]
    return np.concatenate(found)


if __name__ == "__main__":
    main()
