"""Checkpoints: written whole or not at all, and found again after any crash.

A checkpoint is one safetensors file with the parameters, the optimisers' moments and the counters.
It is written under another name, flushed to disk, and renamed. The newest file that can be read
counts.
"""

from __future__ import annotations

import json
import zlib
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from ..errors import UserError
from ..fields.arrays import from_numpy
from ..formats import check_format
from ..io import write_atomically
from .run_folder import RunFolder
from .state import State

#: The newest format that can be read, and the one that is written.
FORMAT = 1
_NAME = "unbake-checkpoint-"


@dataclass
class Progress:
    """How far a fit has come."""

    step: int = 0
    seconds: float = 0.0  #: of training, without previews and checkpoints
    samples: int = 0  #: from the camera, traced in all passes


def save_checkpoint(run: RunFolder, state: State, progress: Progress) -> Path:
    """Write a checkpoint and delete all but the newest few.

    Raises:
        UserError: it cannot be written; older checkpoints are untouched.
    """
    arrays = {}
    for name, optimizer in state.optimizers():
        for key, (value, _, _, extra) in optimizer.state.items():
            count, first, second, _ = extra
            arrays[f"{name}.{key}"] = value.numpy()
            arrays[f"{name}.{key}:m"] = first.numpy()
            arrays[f"{name}.{key}:v"] = second.numpy()
            arrays[f"{name}.{key}:t"] = np.asarray(count).astype(np.uint32).ravel()[:1]
    if state.scale is not None:
        arrays["scale"] = np.array(state.scale)
    metadata = {
        "format": f"{_NAME}{FORMAT}",
        "step": str(progress.step),
        "seconds": repr(progress.seconds),
        "samples": str(progress.samples),
    }
    metadata["crc"] = str(_checksum(arrays, metadata))
    path, content = run.checkpoint(progress.step), save(arrays, metadata)
    write_atomically(path, lambda p: p.write_bytes(content), durable=True, what="checkpoint")
    run.tidy_checkpoints()
    return path


def load_checkpoint(run: RunFolder, state: State) -> Progress | None:
    """Put the newest readable checkpoint into the state; None if none was written yet.

    Raises:
        UserError: the checkpoint belongs to other settings or was written by a newer version, or
            all checkpoints are damaged.
    """
    written = run.written_checkpoints()
    for path in written:
        try:
            with safe_open(path, "numpy") as file:
                metadata = file.metadata() or {}
                arrays = {key: file.get_tensor(key) for key in file.keys()}
        except (SafetensorError, OSError, ValueError, TypeError, MemoryError):
            continue
        crc = metadata.pop("crc", None)
        version = metadata.get("format", "").removeprefix(_NAME)
        if crc != str(_checksum(arrays, metadata)) or not version.isdecimal():
            continue
        check_format({"format": int(version)}, FORMAT, path)
        _restore(state, arrays, path)
        return Progress(int(metadata["step"]), float(metadata["seconds"]), int(metadata["samples"]))
    if written:
        raise UserError("no checkpoint in this folder can be read", run.checkpoints, "Fit again")
    return None


def _checksum(arrays: dict[str, np.ndarray], metadata: dict[str, str]) -> int:
    """CRC-32 of all that a checkpoint holds: safetensors itself would not notice a flipped bit."""
    crc = zlib.crc32(json.dumps(metadata, sort_keys=True).encode())
    for key in sorted(arrays):
        crc = zlib.crc32(f"{key} {arrays[key].dtype} {arrays[key].shape}".encode(), crc)
        crc = zlib.crc32(np.ascontiguousarray(arrays[key]).data, crc)
    return crc


def _restore(state: State, arrays: dict[str, np.ndarray], path: Path) -> None:
    if state.scale is not None and "scale" in arrays:
        state.scale = dr.opaque(mi.Float, float(arrays["scale"][0]))
    for name, optimizer in state.optimizers():
        for key, (value, promoted, rate, _) in list(optimizer.state.items()):
            full = f"{name}.{key}"
            if full not in arrays or arrays[full].shape != tuple(value.shape):
                raise UserError(
                    f"does not fit the settings: {full} is missing or has another shape",
                    where=path,
                    remedy="Resume with the settings that the run was started with",
                )
            first, second = (from_numpy(mi.Float, arrays[f"{full}:{x}"]) for x in "mv")
            count = dr.opaque(mi.UInt32, int(arrays[f"{full}:t"][0]))
            new = from_numpy(mi.Float, arrays[full])
            if dr.is_tensor_v(value):
                new = mi.TensorXf(new, value.shape)
            dr.enable_grad(new)
            optimizer.state[key] = (new, promoted, rate, (count, first, second, None))
