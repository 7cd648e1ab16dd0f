"""Checkpoints: written whole or not at all, and found again after any crash.

    checkpoints/step-NNNNNNNNN/
      state.safetensors     parameters, the optimisers' moments, the scale of the loss
      manifest.json         step and time, the run, seed and settings, size and SHA-256 of the state

Both are written to a temporary folder and flushed to disk before the folder takes its name. The
newest checkpoint of the run that is as its manifest says counts. Version 0.1 wrote one safetensors
file, which is read, too.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import stat
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import load, save

from ..errors import UserError
from ..formats import check_format
from .run_folder import MANIFEST, STATE, SUFFIX_OF_VERSION_0_1, RunFolder, require_no_link
from .state import State

#: The newest format that can be read, and the one that is written. 1 is that of version 0.1.
FORMAT = 2
_NAME = "unbake-checkpoint-"
#: Bytes of a manifest, which has the settings in it, and of what a state has beside its arrays.
_MOST_TEXT = 16 << 20


@dataclass
class Progress:
    """How far a fit has come."""

    step: int = 0
    seconds: float = 0.0  #: of training, without previews and checkpoints
    samples: int = 0  #: from the camera, traced in all passes
    skipped: int = 0  #: steps whose loss was not finite
    rate: float = 1.0  #: factor on all learning rates, less than 1 after the loss has exploded
    #: Losses of photographs in the first steps, for a comparison in the end; none in runs of
    #: version 0.1.
    untrained: tuple[float, ...] = ()
    processes: int = 1  #: that took these first steps together
    #: For how many of its places roughness was searched; None: nobody wrote that down.
    searches: int | None = 0
    searching: float = 0.0  #: seconds of training that were those of searches, not of steps
    last_search: float = 0.0  #: of them, those of the last one
    length: float = 0.0  #: of the fit that `searches` is of, in seconds or steps
    timed: bool | None = None  #: whether that is in seconds; None: nobody wrote that down
    searched: int = 0  #: searches that were made: one may stand for several places
    warning: str | None = None  #: what is wrong with a fit that has ended; not part of checkpoints

    def counted(self) -> dict[str, Any]:
        """Steps, seconds and samples, as lines of the log have them."""
        return {"step": self.step, "seconds": self.seconds, "samples": self.samples}


class _Damaged(Exception):
    """A checkpoint that cannot be used; an older one may."""


def save_checkpoint(
    run: RunFolder, state: State, progress: Progress, about: Mapping[str, Any] | None = None
) -> Path:
    """Write a checkpoint and delete all but the newest few.

    Args:
        about: what the manifest says of the run, as JSON; `run` is the run's identity
            (`Origin.run`), without which it is read only as that of a run without one.

    Returns:
        Its folder.

    Raises:
        UserError: it cannot be written; older checkpoints are untouched.
    """
    content = save(state.arrays())
    manifest = {
        "format": FORMAT,
        **progress.counted(),
        "skipped": progress.skipped,
        "rate": progress.rate,
        "untrained": list(progress.untrained),
        "processes": progress.processes,
        "searches": progress.searches,
        "searching": progress.searching,
        "last_search": progress.last_search,
        "length": progress.length,
        "timed": progress.timed,
        "searched": progress.searched,
        **(about or {}),
        "files": {STATE: {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}},
    }
    manifest["sha256"] = _digest(manifest)
    path = run.checkpoint(progress.step)
    text = (json.dumps(manifest, indent=1) + "\n").encode()
    require_no_link(run.checkpoints)
    try:
        _write_folder(path, {STATE: content, MANIFEST: text})
    except OSError as error:
        what = f"the checkpoint cannot be written ({error.strerror or error})"
        raise UserError(what, path, "Make room, or the folder writable") from error
    run.tidy_checkpoints(path)
    return path


def load_checkpoint(run: RunFolder, state: State) -> Progress | None:
    """Put the newest good checkpoint of the run into the state; None if none was written yet.

    Raises:
        UserError: the checkpoint belongs to other settings or was written by a newer version, or
            none can be used.
    """
    expected = state.arrays()
    for path, arrays, progress in _whole(run, _most(expected)):
        _require_fit(arrays, expected, path)
        state.assign(arrays)
        if run.exists:  # version 0.1 counted the samples of one of two passes
            least = progress.step * run.settings().samples_per_step
            progress.samples = max(progress.samples, least)
        return progress
    return None


def load_written(run: RunFolder, state: State, path: Path) -> Progress | None:
    """Put one checkpoint of the run into the state; None if it is not whole, or not of this run.

    A running fit writes checkpoints and deletes them: one that cannot be read now may be whole a
    moment later, or gone.

    Args:
        path: of `RunFolder.written_checkpoints`.

    Raises:
        UserError: it belongs to other settings or was written by a newer version.
    """
    expected = state.arrays()
    found = _good(path, _most(expected))
    if found is None or found[2].get("run") != _identity(run):
        return None
    arrays, progress, _ = found
    _require_fit(arrays, expected, path)
    state.assign(arrays)
    return progress


def newest_progress(run: RunFolder) -> Progress | None:
    """How far the newest good checkpoint of a run has come; errors as in `load_checkpoint`."""
    return next((progress for *_, progress in _whole(run, 1 << 40)), None)


def _whole(run: RunFolder, most: int) -> Iterator[tuple[Path, dict[str, np.ndarray], Progress]]:
    """The checkpoints of a run that are whole, the newest first.

    Args:
        most: bytes that a state can have; larger files are not read.

    Raises:
        UserError: there are checkpoints, but none that is whole and of this run, or one was written
            by a newer version.
    """
    written, others, found = run.written_checkpoints(), 0, 0
    identity = _identity(run)
    for path in written:
        good = _good(path, most)
        if good is None:
            continue
        arrays, progress, manifest = good
        if manifest.get("run") != identity:
            others += 1
            continue
        found += 1
        yield path, arrays, progress
    if others and not found:
        what = "the checkpoints in this folder are of another run"
        raise UserError(what, run.checkpoints, "Put the right ones back, or fit again")
    if written and not found:
        raise UserError("no checkpoint in this folder can be read", run.checkpoints, "Fit again")


def _good(path: Path, most: int) -> tuple[dict[str, np.ndarray], Progress, dict[str, Any]] | None:
    """The arrays, the progress and the manifest of a checkpoint; None if it is not whole.

    Raises:
        UserError: it was written by a newer version.
    """
    try:
        arrays, manifest = _read(path, most)
        progress = Progress(
            int(manifest["step"]),
            float(manifest["seconds"]),
            int(manifest["samples"]),
            int(manifest.get("skipped", 0)),
            float(manifest.get("rate", 1.0)),
            tuple(map(float, manifest.get("untrained", ()))),
            int(manifest.get("processes", 1)),
            None if manifest.get("searches") is None else int(manifest["searches"]),
            float(manifest.get("searching", 0.0)),
            float(manifest.get("last_search", 0.0)),
            float(manifest.get("length", 0.0)),
            None if manifest.get("timed") is None else bool(manifest["timed"]),
            int(manifest.get("searched", manifest.get("searches") or 0)),
        )
        if not all(np.isfinite(array).all() for array in arrays.values()):
            raise _Damaged("a number is not finite")
    except (_Damaged, OSError, ValueError, TypeError, KeyError, RecursionError, MemoryError):
        return None
    return arrays, progress, manifest


def _identity(run: RunFolder) -> str | None:
    return run.origin().run if run.origin_file.exists() else None


def _most(expected: Mapping[str, np.ndarray]) -> int:
    """Bytes that a state with these arrays can have."""
    return 2 * sum(array.nbytes for array in expected.values()) + _MOST_TEXT


def state_digest(state: State) -> str:
    """SHA-256 of all numbers of a state, the moments among them: equal for the same bits."""
    digest = hashlib.sha256()
    for name, array in state.arrays().items():
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


# ------------------------------------------------------------------------------------------ writing


def _write_folder(path: Path, files: Mapping[str, bytes]) -> None:
    """Write a folder of files so that it is whole once it has its name, also after a power cut."""
    new = not path.parent.is_dir()
    path.parent.mkdir(parents=True, exist_ok=True)
    if new:
        _flush(path.parent.parent)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.mkdir()
        for name, content in files.items():
            with open(temporary / name, "xb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        _flush(temporary)
        if os.path.lexists(path):  # a damaged one, of steps that were taken again
            old = path.with_name(f".{path.name}.{os.getpid()}.old.tmp")
            os.replace(path, old)
            os.replace(temporary, path)
            if old.is_dir() and not old.is_symlink():
                shutil.rmtree(old, ignore_errors=True)
            else:
                old.unlink()
        else:
            os.replace(temporary, path)
        _flush(path.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _flush(folder: Path) -> None:
    """Flush the names in a folder to disk; Windows has no such call."""
    if os.name == "nt":
        return
    number = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


def _digest(manifest: Mapping[str, Any]) -> str:
    """SHA-256 of all that a manifest says, but for this number."""
    said = {key: value for key, value in manifest.items() if key != "sha256"}
    return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()


# ------------------------------------------------------------------------------------------ reading


def _read(path: Path, most: int) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """The arrays and the manifest of a checkpoint.

    Raises:
        UserError: it was written by a newer version.
        _Damaged, OSError, ValueError, TypeError, KeyError, RecursionError, MemoryError: it is not
            a whole checkpoint.
    """
    if path.suffix == SUFFIX_OF_VERSION_0_1:
        return _read_version_0_1(path, most)
    if path.is_symlink():
        raise _Damaged("is a link")
    manifest = json.loads(_content(path / MANIFEST, _MOST_TEXT))
    if not isinstance(manifest, dict) or manifest.get("sha256") != _digest(manifest):
        raise _Damaged("the manifest was changed")
    check_format(manifest, FORMAT, path)
    content, told = _content(path / STATE, most), manifest["files"][STATE]
    if hashlib.sha256(content).hexdigest() != told["sha256"]:
        raise _Damaged("the state was changed")
    try:
        return load(content), manifest
    except SafetensorError as error:
        raise _Damaged("the state cannot be read") from error


def _content(path: Path, most: int) -> bytes:
    """The content of a plain file. Links, pipes, devices and too large files are not read."""
    flags = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)
    number = os.open(path, os.O_RDONLY | flags | getattr(os, "O_BINARY", 0))
    with open(number, "rb") as file:
        about = os.fstat(number)
        if not stat.S_ISREG(about.st_mode) or about.st_size > most:
            raise _Damaged("is not a plain file of this size")
        return file.read(about.st_size)


def _read_version_0_1(path: Path, most: int) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    about = path.lstat()
    if not stat.S_ISREG(about.st_mode) or about.st_size > most:
        raise _Damaged("is not a plain file of this size")
    try:
        with safe_open(path, "numpy") as file:
            metadata = file.metadata() or {}
            arrays = {key: file.get_tensor(key) for key in file.keys()}
    except SafetensorError as error:
        raise _Damaged("cannot be read") from error
    checksum = metadata.pop("crc", None)
    version = metadata.get("format", "").removeprefix(_NAME)
    if checksum != str(_checksum(arrays, metadata)) or not version.isdecimal():
        raise _Damaged("was changed")
    check_format({"format": int(version)}, 1, path)
    return arrays, metadata


def _checksum(arrays: dict[str, np.ndarray], metadata: dict[str, str]) -> int:
    """CRC-32 of all that a checkpoint of version 0.1 holds."""
    crc = zlib.crc32(json.dumps(metadata, sort_keys=True).encode())
    for key in sorted(arrays):
        crc = zlib.crc32(f"{key} {arrays[key].dtype} {arrays[key].shape}".encode(), crc)
        crc = zlib.crc32(np.ascontiguousarray(arrays[key]).data, crc)
    return crc


def _require_fit(
    arrays: Mapping[str, np.ndarray], expected: Mapping[str, np.ndarray], path: Path
) -> None:
    for name, wanted in expected.items():
        found = arrays.get(name)
        if found is None and name == "scale":  # of a fit in single precision
            continue
        if found is None or (found.shape, found.dtype) != (wanted.shape, wanted.dtype):
            raise UserError(
                f"does not fit the settings: {name} is missing or has another shape",
                where=path,
                remedy="Resume with the settings that the run was started with",
            )
