"""Place the cameras of a scene, as `unbake capture` would, and write them to a camera file.

    python scripts/place_cameras.py SCENE.xml --views 26 --held-out 6 --out cameras.json

Prints the share of the reachable surface that the training views see.
"""

import argparse
from pathlib import Path

from unbake import activate


def main() -> None:
    """Write a camera file for the scene that the command line names."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--views", type=int, required=True)
    parser.add_argument("--held-out", type=int, default=6)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    activate()
    from unbake.acquisition.coverage import coverage
    from unbake.acquisition.placement import place
    from unbake.dataset.camera_files import write_camera_file
    from unbake.scene.edit import to_principled
    from unbake.scene.parse import parse

    parsed = parse(args.scene)
    to_principled(parsed)
    scene = parsed.instantiate(merge=False)
    placed = place(scene, args.views, args.held_out, seed=args.seed)
    train = [look.camera(64, 64) for split, look in placed if split == "train"]
    write_camera_file(args.out, placed)
    print(f"{args.out}: the training views see {100 * coverage(scene, train):.0f} % of the surface")


if __name__ == "__main__":
    main()
