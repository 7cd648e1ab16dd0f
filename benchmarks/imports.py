"""Whether a data set that was written in the layout of another program fits as it did before.

    python benchmarks/imports.py --data DATA --runs FOLDER --out FILE.json [--seeds 0 1 2]
        [--steps 600]

DATA, one of `unbake capture`, is written in each layout and imported again, with its meshes one by
one and its lights. Photographs are linear OpenEXR in the layouts of FIPT and 8-bit PNG in the
others. What neither cameras nor meshes tell is put back: which views are held out, the specular
reflectance of plastics, and materials that are not fitted, such as mirrors. Scores are those of
the recovered materials, as the held-out views of DATA see them, PSNR in dB of linear RGB.

What FOLDER has already is not made again.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from here import ROOT

import numpy as np
from poses import as_seen, fit  # activates a variant

sys.path.insert(0, str(ROOT / "tests"))

import layouts

from unbake.config.light import LightConfig
from unbake.dataset.views import Dataset, View
from unbake.experiments.seeds import across_seeds
from unbake.importing.import_data import import_data
from unbake.importing.settings import ImportSettings
from unbake.io import write_json
from unbake.machine import machine
from unbake.training.recovered import load_run
from unbake.training.run_folder import RunFolder

#: The data set as it was captured.
CAPTURED = "captured"
#: Of positions of cameras, beside the extent of the scene: COLMAP's text has float64.
_SAME = 1e-4


def write_binary_colmap(captured: Dataset, folder: Path) -> None:
    """A project of COLMAP with a binary model."""
    import pycolmap

    layouts.write_colmap(captured, folder)
    model = folder / "sparse" / "0"
    found = pycolmap.Reconstruction(model)
    for file in model.glob("*.txt"):
        file.unlink()
    found.write_binary(model)


def of_room(
    write: Callable[[Dataset, list[Path], Path], None], meshes: list[Path]
) -> Callable[[Dataset, Path], None]:
    """A writer of a room, which has its geometry in it."""
    return lambda captured, folder: write(captured, meshes, folder)


def main() -> None:
    """Import, fit, print every score, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, help="data set of `unbake capture`")
    parser.add_argument("--runs", type=Path, required=True, help="folder for data sets and runs")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--steps", type=int, default=600)
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    args = parser.parse_args()
    args.runs.mkdir(parents=True, exist_ok=True)
    captured = Dataset.load(args.data)
    meshes = meshes_of(captured.scene)
    written: dict[str, Callable[[Dataset, Path], None]] = {
        "nerfstudio": layouts.write_nerfstudio,
        "blender": layouts.write_blender,
        "colmap-text": layouts.write_colmap,
        "colmap-binary": write_binary_colmap,
        "fipt-photographed": of_room(layouts.write_photographed_room, meshes),
        "fipt-rendered": of_room(layouts.write_rendered_room, meshes),
    }
    sets = {CAPTURED: args.data}
    for name, write in written.items():
        source, sets[name] = args.runs / f"source-{name}", args.runs / f"data-{name}"
        if not source.is_dir():
            write(captured, source)
        if not sets[name].is_dir():
            imported(source, captured, meshes, sets[name])
    found: dict[str, list[dict[str, float]]] = {name: [] for name in sets}
    for seed in args.seeds:
        for name, data in sets.items():
            run = args.runs / f"run-{name}-{seed}"
            fit(data, run, ["--seed", seed, "--steps", args.steps])
            row = as_seen(load_run(run), captured)
            found[name].append(row | {"seconds": RunFolder(run).metrics()["seconds"]})
            told = ", ".join(f"{key} {value:.2f}" for key, value in row.items())
            print(f"{name}, seed {seed}: {told}", flush=True)
    about = {
        "machine": machine(),
        "data": args.data.name,
        "seeds": args.seeds,
        "steps": args.steps,
        "train": len(captured.train),
        "heldout": len(captured.heldout),
    }
    rows = [{"layout": k} | across_seeds(v, v[0]) | {"runs": v} for k, v in found.items()]
    write_json(args.out, about | {"rows": rows})


def meshes_of(scene: Path) -> list[Path]:
    """The meshes that are no lights, in the order of the scene file."""
    shapes = ElementTree.parse(scene).getroot().findall("shape")
    dark = [shape for shape in shapes if shape.find("emitter") is None]
    names = [shape.find("string[@name='filename']") for shape in dark]
    return [scene.parent / name.get("value", "") for name in names if name is not None]


def imported(source: Path, captured: Dataset, meshes: list[Path], out: Path) -> None:
    """Import a folder, and put back what it does not tell.

    Args:
        source: as another program writes it.
        captured: what was written.
        meshes: of its scene.
        out: new folder.
    """
    # Not hidden, by Blender's alpha: that would be another problem.
    settings = ImportSettings(background="visible")
    light = LightConfig(lights=str(captured.scene))
    made = import_data(source, out, meshes, settings, light=light, allow_outside=True)
    put_back_splits(made.transforms_file, captured.views)
    put_back_materials(Dataset.load(out).scene, captured.scene)


def put_back_splits(file: Path, views: tuple[View, ...]) -> None:
    """Hold the same views out, found by the places of their cameras."""
    places = np.array([view.camera.to_world[:3, 3] for view in views])
    content = json.loads(file.read_text("utf-8"))
    assert len(content["frames"]) == len(views)
    for frame in content["frames"]:
        away = np.linalg.norm(places - np.array(frame["transform_matrix"])[:3, 3], axis=1)
        assert away.min() < _SAME * np.ptp(places)
        frame["split"] = views[int(away.argmin())].split
    write_json(file, content)


def put_back_materials(file: Path, scene: Path) -> None:
    """Give plastics their specular reflectance, and other materials themselves.

    Args:
        file: scene of `unbake import`, whose materials have the names of meshes.
        scene: of the data set before.
    """
    before, after = ElementTree.parse(scene).getroot(), ElementTree.parse(file)
    materials = {bsdf.get("id"): bsdf for bsdf in before.findall("bsdf")}
    for shape in before.findall("shape"):
        name = Path(shape.find("string[@name='filename']").get("value")).stem  # type: ignore
        true = materials[shape.find("ref[@name='bsdf']").get("id")]  # type: ignore
        sides = after.getroot().find(f"bsdf[@id='{name}_sides']")
        if sides is None:  # a light
            continue
        found: Any = sides.find("bsdf")
        if true.get("type") == "principled":
            found.extend(true.findall("float[@name='specular']"))
        else:
            sides.remove(found)
            sides.append(true)
    after.write(file, encoding="utf-8", xml_declaration=True)


if __name__ == "__main__":
    main()
