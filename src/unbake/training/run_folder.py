"""The folder of a run: where its files lie, and what is read from and written to them.

    RUN/
      config.toml                      settings
      origin.json                      the data set that the run was fit to
      log.jsonl                        losses and scores, one line every few steps
      checkpoints/step-NNNNNNNNN/      state, manifest (`checkpoint.py`)
      previews/step-NNNNNN.png
      evaluation/metrics.json          what `unbake evaluate` measured
      evaluation/SPLIT/VIEW_QUANTITY.exr, .png
      evaluation/environment.exr, .png
      evaluation/environment_unobserved.png  where nothing is known of it
      tensorboard/                     the numbers of the log for TensorBoard, if wanted
      .lock                            the process that fits (`run_lock.py`)

No other module names these files.
"""

from __future__ import annotations

import json
import math
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, final

from .. import json_checks
from ..config import FitConfig, read_toml, to_tables, to_toml
from ..errors import UserError, quoted
from ..formats import check_format
from ..io import (
    read_lines,
    read_object,
    read_text,
    require_utf8,
    unfinished,
    write_json,
    write_text,
)
from ..machine import same_machine
from ..signals import cleaned_up
from . import run_numbers
from .event_log import EventLog
from .run_lock import RunLock

#: The newest formats of `origin.json` and `metrics.json` that can be read, and those written.
ORIGIN_FORMAT = 2
METRICS_FORMAT = 1
#: Checkpoints kept in a run folder.
KEEP = 3
#: The files of a checkpoint.
STATE, MANIFEST = "state.safetensors", "manifest.json"
#: A checkpoint of version 0.1 is a file.
SUFFIX_OF_VERSION_0_1 = ".safetensors"
_CHECKPOINT = re.compile(r"step-(\d{1,18})(\.safetensors)?", re.ASCII)
_GIVE_RUN = "Give the folder of a run"
_MACHINES = json_checks.list_of(json_checks.any_object)
_LEVEL = json_checks.or_none(lambda value: json_checks.count(value) and value > 0)


@final
@dataclass(frozen=True)
class WarmStart:
    """The solved radiance field that a run started with (`solved.py`)."""

    folder: str
    scene: str  #: that was solved, for people
    steps: int  #: of the solve
    sha256: str  #: of the file with its parameters
    scale: float  #: of the field, which the parameters of the run belong to; see `RadianceField`

    @staticmethod
    def read(facts: Any) -> WarmStart | None:
        """What an origin tells; None where there was none.

        Raises:
            ValueError: it is damaged.
        """
        match facts:
            case None:
                return None
            case {
                "folder": str(folder),
                "scene": str(scene),
                "steps": int(steps),
                "sha256": str(sha256),
                "scale": float(scale),
            } if 0 < scale < math.inf:
                return WarmStart(folder, scene, steps, sha256, scale)
        raise ValueError("no warm start")


@final
@dataclass(frozen=True)
class Origin:
    """The input of a run, beside its settings."""

    data: str  #: the data set's folder; a relative path starts at the run folder
    mean_radiance: float  #: of its training pixels
    clip_negative: bool
    #: Chosen at the start of a run; its checkpoints name it, too. None: begun by version 0.1.
    run: str | None = None
    #: Of the data set (`dataset/fingerprint.py`); empty: begun by version 0.1.
    fingerprint: Mapping[str, str] = field(default_factory=dict)
    warm_start: WarmStart | None = None  #: None: the radiance field started untrained
    #: That took steps, in their order (`machine.machine`); empty: none did, or nobody wrote it.
    machines: tuple[Mapping[str, Any], ...] = ()
    #: Of the photographs, which is the scale of a radiance field that is untrained; see
    #: `Photographs`. None: that was their mean radiance.
    level: float | None = None

    def on(self, machine: Mapping[str, Any]) -> Origin:
        """The same of a run whose next steps are taken on a machine."""
        known = any(same_machine(machine, other) for other in self.machines)
        return self if known else replace(self, machines=(*self.machines, machine))

    @property
    def photographs_level(self) -> float:
        """The level of the photographs, as the run has it."""
        return self.mean_radiance if self.level is None else self.level

    @property
    def radiance_scale(self) -> float:
        """The scale of the radiance field."""
        return self.photographs_level if self.warm_start is None else self.warm_start.scale


@final
@dataclass(frozen=True)
class EvaluationFolder:
    """The pictures of an evaluation.

    Args:
        path: the folder.
    """

    path: Path

    def picture(self, split: str, view: str, quantity: str, suffix: str = ".exr") -> Path:
        """The final picture of a quantity, such as "render" or "albedo", in a view.

        Args:
            split: of the view: "train" or "heldout".
            suffix: ".exr" (linear) or ".png" (for display).
        """
        return self.path / split / f"{view}_{quantity}{suffix}"

    def environment(self, suffix: str = ".exr") -> Path:
        """The picture of the recovered environment map; `suffix` as in `picture`."""
        return self.path / f"environment{suffix}"

    def unobserved_environment(self) -> Path:
        """White where nothing is known of the map; there is no such picture of a known one."""
        return self.path / "environment_unobserved.png"


@final
@dataclass(frozen=True)
class RunFolder:
    """The files of a run.

    Args:
        path: the folder; it need not exist yet.
    """

    path: Path

    def __post_init__(self) -> None:
        object.__setattr__(self, "path", Path(self.path))

    @property
    def config_file(self) -> Path:
        """The settings."""
        return self.path / "config.toml"

    @property
    def origin_file(self) -> Path:
        """The data set that the run was fit to."""
        return self.path / "origin.json"

    @property
    def log_file(self) -> Path:
        """Losses and scores over time, a JSON object a line."""
        return self.path / "log.jsonl"

    @property
    def checkpoints(self) -> Path:
        """The folder of checkpoints."""
        return self.path / "checkpoints"

    @property
    def previews(self) -> Path:
        """The folder of previews."""
        return self.path / "previews"

    @property
    def evaluation(self) -> Path:
        """The folder of final renderings and numbers."""
        return self.path / "evaluation"

    @property
    def tensorboard(self) -> Path:
        """The folder of the log for TensorBoard."""
        return self.path / "tensorboard"

    @property
    def metrics_file(self) -> Path:
        """The numbers of the evaluation."""
        return self.evaluation / "metrics.json"

    @property
    def exists(self) -> bool:
        """Whether a fit was started in this folder."""
        return self.config_file.is_file()

    # ------------------------------------------------------------------ settings and origin

    def require_new(self) -> None:
        """Refuse a folder that holds a run or what is left of one, so that no two are mixed.

        Raises:
            UserError: there is one.
        """
        require_utf8(self.path, "run folder")
        if self.config_file.exists():
            raise UserError(
                "there is a run in this folder already",
                where=self.path,
                remedy="Go on with --resume, or give another --out",
            )
        folders = (self.checkpoints, self.previews, self.evaluation, self.tensorboard)
        left = [x.name for x in folders if _filled(x)]
        if self.log_file.is_symlink() or (self.log_file.exists() and self.log_file.stat().st_size):
            left.append(self.log_file.name)
        if left:
            raise UserError(
                f"holds parts of another run ({', '.join(left)}), but not its config.toml",
                where=self.path,
                remedy="Remove them, or give another --out",
            )

    def lock(self, doing: str = "fits") -> RunLock:
        """The lock of the folder, which whoever writes to it must hold.

        Raises:
            UserError: a part of the run lies elsewhere, behind a symbolic link; on entering,
                another process has the lock.
        """
        for part in (self.log_file, self.checkpoints, self.previews, self.tensorboard):
            require_no_link(part)
        return RunLock(self.path, doing)

    def lock_evaluation(self) -> RunLock:
        """The lock of the folder of the evaluation; errors as in `lock`."""
        for part in (self.evaluation, *self.evaluation.glob("*/")):
            require_no_link(part)
        return RunLock(self.evaluation, "evaluates")

    def require_resumable(self) -> None:
        """Refuse a folder without a run.

        Raises:
            UserError: there is no run.
        """
        if not self.exists:
            what = "there is no run to resume in this folder"
            raise UserError(what, self.path, "Leave out --resume")

    def require_fitted(self) -> None:
        """Refuse a folder in which no fit was started.

        Raises:
            UserError: settings or origin are missing.
        """
        require_utf8(self.path, "run folder")
        if not self.exists or not self.origin_file.is_file():
            raise UserError("no run in this folder", self.path, "Make one with `unbake fit`")

    def settings(self) -> FitConfig:
        """The settings of the run.

        Raises:
            UserError: they are missing or damaged.
        """
        config = read_toml(self.config_file)
        if config.method == "with-prior" and not any(config.rate_factors.values()):
            # Version 0.1 had no factors, and squared the residuals of this method.
            config = replace(config, method="with-biased-prior")
        return config

    def settings_table(self) -> dict[str, Any]:
        """The settings as tables, with today's names, also where a value is none of today's.

        Raises:
            UserError: the file is missing, is not TOML, or is of a newer version.
        """
        text = read_text(self.config_file, _GIVE_RUN)
        return to_tables(text, str(self.config_file))

    def write_settings(self, config: FitConfig) -> None:
        """Write the settings; this makes the folder that of a run."""
        write_text(self.config_file, to_toml(config))

    def origin(self) -> Origin:
        """The input of the run.

        Raises:
            UserError: the file is missing, damaged, or of a newer version.
        """
        again = "Fit again into another folder"
        try:
            facts = read_object(self.origin_file)
        except UserError:
            raise UserError("cannot be read", self.origin_file, again) from None
        check_format(facts, ORIGIN_FORMAT, self.origin_file)
        match facts:
            case {
                "data": str(data),
                "mean_radiance": float(radiance),
                "clip_negative": bool(clip),
            } if data and "\0" not in data and 0 < radiance < math.inf:
                run, fingerprint = facts.get("run"), facts.get("fingerprint", {})
                machines, level = facts.get("machines", []), facts.get("level")
                texts = fingerprint.values() if isinstance(fingerprint, dict) else (None,)
                good = isinstance(run, str | None) and all(isinstance(x, str) for x in texts)
                good = good and _LEVEL(level)
                if good and _MACHINES(machines):
                    with suppress(ValueError):
                        start = WarmStart.read(facts.get("warm_start"))
                        return Origin(
                            data, radiance, clip, run, fingerprint, start, tuple(machines), level
                        )
        raise UserError("cannot be read", self.origin_file, again)

    def write_origin(self, origin: Origin) -> None:
        """Write the input of the run."""
        write_json(self.origin_file, {"format": ORIGIN_FORMAT} | asdict(origin))

    def data(self, named: str) -> Path:
        """The folder of a data set that a file of the run names, relative to the run or not."""
        return self.path / named

    # --------------------------------------------------------------------------- progress

    def log(self) -> list[dict[str, Any]]:
        """The log's lines; a torn last line, as a killed run leaves it, is left out.

        Raises:
            UserError: there is no log, or a line before the last is not JSON.
        """
        file = self.log_file
        if not file.is_file():
            raise UserError("the run has no log", file, _GIVE_RUN)
        lines: list[dict[str, Any]] = []
        torn: int | None = None
        for number, text in enumerate(read_lines(file), start=1):
            if not text.strip():
                continue
            if torn is not None:
                raise UserError(f"line {torn} is not JSON", file, "Remove the line")
            try:
                line = json.loads(text)
            except (ValueError, RecursionError):
                torn = number
                continue
            wrong = run_numbers.wrong_in_log(line)
            if wrong:
                raise UserError(f"line {number}: {wrong}", file, "Remove the line")
            lines.append(line)
        return lines

    def events(self, first: int) -> EventLog:
        """A new file for TensorBoard; see `EventLog`.

        Raises:
            UserError: it cannot be made.
        """
        try:
            return EventLog(self.tensorboard, first)
        except OSError as error:
            what = f"the log for TensorBoard cannot be written ({error.strerror})"
            raise UserError(
                what, self.tensorboard, "Make room, or leave out --tensorboard"
            ) from None

    def forget_after(self, step: int) -> None:
        """Drop the lines of the log after a step, and lines that a killed fit left half-written.

        A resumed fit takes those steps again. Verdicts on the whole fit are dropped, too: it ends
        once more.
        """
        log, kept = self.log_file, []
        require_no_link(log)
        lines = log.read_bytes().splitlines() if log.is_file() else ()
        for line in (line.decode("utf-8", "replace") for line in lines):
            try:
                found = json.loads(line)
                if found["step"] <= step and not found.get("verdict"):
                    kept.append(line + "\n")
            except (ValueError, KeyError, TypeError, RecursionError):
                continue
        write_text(log, "".join(kept))

    def checkpoint(self, step: int) -> Path:
        """The folder of the checkpoint after a number of steps."""
        return self.checkpoints / f"step-{step:09d}"

    def written_checkpoints(self) -> list[Path]:
        """The existing checkpoints, whole or not, the newest first; of version 0.1 they are files.

        Names count as numbers: as texts, step 10,000,000 would come before step 9,999,999.
        """
        if not self.checkpoints.is_dir():
            return []
        found = ((_CHECKPOINT.fullmatch(path.name), path) for path in self.checkpoints.iterdir())
        numbered = [(int(match[1]), path) for match, path in found if match]
        return [path for _, path in sorted(numbered, reverse=True)]

    def tidy_checkpoints(self, newest: str | Path) -> None:
        """Delete all checkpoints but this one, which is good, and the newest few before it.

        Those after it are damaged, or of steps that were taken again.
        """
        written = self.written_checkpoints()
        at = written.index(Path(newest))
        _remove(*written[:at], *written[at + KEEP :])

    def sweep(self) -> None:
        """Delete what a killed process left unfinished; only with the lock.

        The folder itself may be one with files of other programs, such as the present one.
        """
        for file in (self.config_file, self.origin_file, self.log_file):
            _remove(*(path for path in unfinished(file) if path.is_file() or path.is_symlink()))
        for folder in (self.checkpoints, self.previews):
            # Version 0.1 wrote checkpoints under the name of `*.partial`.
            _remove(*folder.glob(".*.tmp"), *folder.glob("step-*.partial"))

    def preview(self, step: int) -> Path:
        """The preview after a number of steps."""
        return self.previews / f"step-{step:06d}.png"

    # -------------------------------------------------------------------------- evaluation

    def picture(self, split: str, view: str, quantity: str, suffix: str = ".exr") -> Path:
        """A picture of the evaluation; see `EvaluationFolder.picture`."""
        return EvaluationFolder(self.evaluation).picture(split, view, quantity, suffix)

    def environment(self, suffix: str = ".exr") -> Path:
        """The environment map of the evaluation; see `EvaluationFolder.environment`."""
        return EvaluationFolder(self.evaluation).environment(suffix)

    def unobserved_environment(self) -> Path:
        """Where nothing is known of it; see `EvaluationFolder.unobserved_environment`."""
        return EvaluationFolder(self.evaluation).unobserved_environment()

    @contextmanager
    def new_evaluation(self) -> Iterator[EvaluationFolder]:
        """A folder for the pictures of a further evaluation, which `replace_evaluation` takes.

        The one before stays as it is until then, and where there is no further one. Only with the
        lock.
        """
        new = self.evaluation / ".new"
        # What a killed one left; until version 0.2 that lay beside pictures.
        _remove(new, *self.evaluation.glob("**/.*.tmp"))
        with cleaned_up(lambda: _remove(new)):
            yield EvaluationFolder(new)

    def replace_evaluation(self, new: EvaluationFolder, metrics: Mapping[str, Any]) -> None:
        """Put another evaluation, pictures and numbers, in the place of the one before.

        Raises:
            OSError, UserError: a file cannot be written.
        """
        self.metrics_file.unlink(missing_ok=True)  # of no other pictures than its own
        _remove(*(self.evaluation / split for split in ("train", "heldout")))
        _remove(*(self.environment(suffix) for suffix in (".exr", ".png")))
        _remove(self.unobserved_environment())
        for path in new.path.glob("*"):
            path.rename(self.evaluation / path.name)
        write_json(self.metrics_file, metrics)

    def metrics(self) -> dict[str, Any]:
        """The numbers of the evaluation.

        Raises:
            UserError: the run was not evaluated, or the file is damaged or of a newer version.
        """
        metrics = read_object(self.metrics_file, self.evaluate_again)
        check_format(metrics, METRICS_FORMAT, self.metrics_file)
        wrong = run_numbers.wrong_in_metrics(metrics)
        if wrong:
            raise UserError(wrong, self.metrics_file, self.evaluate_again)
        return metrics

    @property
    def evaluate_again(self) -> str:
        """The remedy where an evaluation is missing or damaged."""
        return f"Run `unbake evaluate {quoted(self.path)}`"


def require_no_link(path: Path) -> None:
    """Refuse a symbolic link: what is written to a run stays in its folder.

    Raises:
        UserError: it is one.
    """
    if path.is_symlink():
        raise UserError("is a symbolic link", path, "Put what it names in its place")


def _filled(folder: Path) -> bool:
    """Whether there is something other than an empty folder."""
    if folder.is_symlink() or not folder.is_dir():
        return folder.is_symlink() or folder.exists()
    return any(folder.iterdir())


def _remove(*paths: Path) -> None:
    for path in paths:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
