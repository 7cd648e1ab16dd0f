"""Data sets of the paper's scenes, for `benchmarks/variants.py` and other scripts.

    python benchmarks/capture.py --scenes scenes --out DATA [--names kitchen dragon ...]

Cameras, changes to the scenes and size (128 x 128) are those of `unbake reproduce fig6`. Rooms
have a quarter of its samples a pixel, STAIRCASE and objects as many.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import here

from unbake import backend
from unbake.acquisition.capture import capture
from unbake.experiments.experiment import ExperimentContext
from unbake.experiments.scenes import SCENES, STAIRCASE, PaperScene

#: Samples of fig. 6 over those here, in rooms.
_FEWER = 4


def main() -> None:
    """Render the data sets that are not there."""
    names = [scene.folder for scene in SCENES]
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenes", type=Path, required=True, help="folder of published scenes")
    parser.add_argument("--out", type=Path, required=True, help="gets a folder for each scene")
    parser.add_argument("--names", nargs="+", choices=names, default=names)
    args = parser.parse_args()
    backend.activate()
    context = ExperimentContext("cpu", args.out / "work", args.scenes)
    for scene in SCENES:
        folder = args.out / scene.folder
        if scene.folder in args.names and not folder.exists():
            render(scene, folder, context)


def render(scene: PaperScene, folder: Path, context: ExperimentContext) -> None:
    """Render a data set."""
    fewer = _FEWER if scene.room and scene is not STAIRCASE else 1
    shots = dataclasses.replace(
        scene.capture_settings(context), resolution=128, spp=scene.spp // fewer
    )
    capture(str(scene.unpacked(context)), folder, shots, cameras=scene.cameras, tell=context.tell)


if __name__ == "__main__":
    main()
