"""What a data set holds, as a few short texts that differ where it was changed."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any

from ..errors import UserError
from ..scene.parse import parse
from ..threads import usable_cores
from .views import Dataset

_CHUNK = 1 << 20  # bytes


def fingerprint(dataset: Dataset) -> dict[str, str]:
    """SHA-256 of the parts of a data set: `photographs`, `poses`, `views` and `scene`.

    `photographs` are the image files with masks, exposures, limits and noise, `poses` the cameras
    with their intrinsics, `views` the names and splits, and `scene` the scene with its meshes,
    textures and included files. Where the folder lies does not count. Files are read, not decoded:
    about a second for a gigabyte on each core.

    Raises:
        UserError: a file cannot be read, or the scene is none.
    """
    views = dataset.views
    photographs: list[Any] = _of_files(view.image for view in views)
    masks = [view.name for view in views if view.mask is not None]
    if masks:
        files = _of_files(view.mask for view in views if view.mask is not None)
        photographs = [photographs, masks, files]
    known = [[view.exposure, view.clipped] for view in views]
    if any(pair != [1, None] for pair in known):
        photographs = [photographs, known]
    noise = [None if view.noise is None else asdict(view.noise) for view in views]
    if any(noise):
        photographs = [photographs, noise]
    return {"photographs": _of_values(photographs)} | geometry_fingerprint(dataset)


def geometry_fingerprint(dataset: Dataset) -> dict[str, str]:
    """SHA-256 of the parts that are not pictures: `poses`, `views` and `scene`.

    Raises:
        UserError: a file cannot be read, or the scene is none.
    """
    views = dataset.views
    cameras = [view.camera for view in views]
    poses = [[c.to_world.tolist(), c.fl_x, c.fl_y, c.cx, c.cy, c.width, c.height] for c in cameras]
    return {
        "poses": _of_values(poses),
        "views": _of_values([dataset.background, *([view.name, view.split] for view in views)]),
        "scene": _of_values(_of_files(_scene_files(dataset))),
    }


def truth_fingerprint(dataset: Dataset, quantities: Iterable[str]) -> dict[str, str]:
    """SHA-256 of the parts that decide which true materials are seen where.

    `poses`, `views` and `scene` as in `fingerprint`, and `truth`: the true maps of the quantities,
    with masks.

    Raises:
        UserError: a file cannot be read, or the scene is none.
    """
    chosen = [(name, view.truth.get(name)) for name in quantities for view in dataset.views]
    named = [[name, file is not None] for name, file in chosen]
    truth = [named, _of_files(file for _, file in chosen if file is not None)]
    masks = {view.name: view.mask for view in dataset.views if view.mask is not None}
    if masks:
        truth += [list(masks), _of_files(masks.values())]
    return geometry_fingerprint(dataset) | {"truth": _of_values(truth)}


def changed(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """The parts that differ, of those that both fingerprints have."""
    return [part for part, value in before.items() if now.get(part, value) != value]


def _scene_files(dataset: Dataset) -> list[Path]:
    """The files of a scene: those of its text, then what these name, in their order."""
    state = parse(dataset.scene, dataset.root).state
    named = (node.props[key] for node in state.nodes for key in node.props)
    texts = (str(value) for value in named if isinstance(value, str) and os.path.isabs(value))
    return [Path(str(name)) for name in (*state.files, *filter(os.path.isfile, texts))]


def _of_values(values: Any) -> str:
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()


def _of_files(files: Iterable[Path]) -> list[str]:
    with ThreadPoolExecutor(usable_cores()) as threads:
        return list(threads.map(_of_file, files))


def _of_file(file: Path) -> str:
    found = hashlib.sha256()
    try:
        with open(file, "rb", buffering=0) as content:
            while chunk := content.read(_CHUNK):
                found.update(chunk)
    except OSError as error:
        raise UserError(f"the file cannot be read ({error.strerror})", file) from None
    return found.hexdigest()
