"""Data sets of the paper's and of other scenes, for `benchmarks/variants.py` and other scripts.

    python benchmarks/capture.py --scenes scenes --out DATA [--names kitchen dragon ...]
    python benchmarks/capture.py --hand-made --out DATA [--names house corridor ...]

Of the paper's scenes, cameras, changes and size (128 x 128) are those of `unbake reproduce fig6`.
Rooms have a quarter of its samples a pixel, STAIRCASE and objects as many. The scenes of
`benchmarks/hand_made` have cameras that unbake chooses: 16 views and 3 held-out ones of 64 x 64
pixels and 256 samples.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

from here import ROOT

from unbake import backend
from unbake.acquisition.capture import capture
from unbake.acquisition.settings import CaptureSettings
from unbake.experiments.experiment import ExperimentContext
from unbake.experiments.scenes import SCENES, STAIRCASE, PaperScene

#: Samples of fig. 6 over those here, in rooms.
_FEWER = 4
_XML = sorted((ROOT / "benchmarks" / "hand_made").glob("*.xml"))
_HAND_MADE = {file.stem: file for file in _XML}
_SHOTS = CaptureSettings(views=16, held_out=3, resolution=64, spp=256)


def main() -> None:
    """Render the data sets that are not there."""
    published = {scene.folder: scene for scene in SCENES}
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    which = parser.add_mutually_exclusive_group(required=True)
    which.add_argument("--scenes", type=Path, help="folder of published scenes")
    which.add_argument("--hand-made", action="store_true", help="those of benchmarks/hand_made")
    parser.add_argument("--out", type=Path, required=True, help="gets a folder for each scene")
    parser.add_argument("--names", nargs="+", help="of scenes (default: all)")
    args = parser.parse_args()
    there = _HAND_MADE if args.hand_made else published
    names = args.names or list(there)
    if unknown := set(names) - there.keys():
        parser.error(f"no scene {', '.join(sorted(unknown))}; there are {', '.join(there)}")
    backend.activate()
    for name in names:
        folder = args.out / name
        if folder.exists():
            continue
        if args.hand_made:
            capture(str(_HAND_MADE[name]), folder, _SHOTS)
        else:
            context = ExperimentContext("cpu", args.out / "work", args.scenes)
            render(published[name], folder, context)


def render(scene: PaperScene, folder: Path, context: ExperimentContext) -> None:
    """Render a data set."""
    fewer = _FEWER if scene.room and scene is not STAIRCASE else 1
    shots = dataclasses.replace(
        scene.capture_settings(context), resolution=128, spp=scene.spp // fewer
    )
    capture(str(scene.unpacked(context)), folder, shots, cameras=scene.cameras, tell=context.tell)


if __name__ == "__main__":
    main()
