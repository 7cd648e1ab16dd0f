"""The folder of a run: where its files lie, and what is read from and written to them.

    RUN/
      config.toml                      settings
      origin.json                      the data set that the run was fit to
      log.jsonl                        losses and scores, one line every few steps
      checkpoints/step-NNNNNNN.safetensors
      previews/step-NNNNNN.png
      evaluation/metrics.json          what `unbake evaluate` measured
      evaluation/SPLIT/VIEW_QUANTITY.exr, .png
      evaluation/environment.exr, .png

No other module names these files.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, final

from ..config import FitConfig, read_toml, to_toml
from ..config.migration import migrated
from ..errors import UserError
from ..formats import check_format
from ..io import read_object, read_text, remove_unfinished, write_json, write_text

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

#: The newest formats of `origin.json` and `metrics.json` that can be read, and those written.
ORIGIN_FORMAT = 1
METRICS_FORMAT = 1
#: Checkpoints kept in a run folder.
KEEP = 3
_GIVE_RUN = "Give the folder of a run"


@final
@dataclass(frozen=True)
class Origin:
    """The input of a run, beside its settings."""

    data: str  # the data set's folder; a relative path starts at the run folder
    mean_radiance: float  # of its training pixels; the scale of the radiance field
    clip_negative: bool


@final
@dataclass(frozen=True)
class RunFolder:
    """The files of a run.

    Args:
        path: the folder; it need not exist yet.
    """

    path: Path

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
    def metrics_file(self) -> Path:
        """The numbers of the evaluation."""
        return self.evaluation / "metrics.json"

    @property
    def exists(self) -> bool:
        """Whether a fit was started in this folder."""
        return self.config_file.is_file()

    # ------------------------------------------------------------------ settings and origin

    def require_new(self) -> None:
        """Refuse a folder that holds a run already, so that no two runs are mixed.

        Raises:
            UserError: there is a run.
        """
        if self.config_file.exists():
            raise UserError(
                "there is a run in this folder already",
                where=self.path,
                remedy="Go on with --resume, or give another --out",
            )

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
        try:
            return migrated(tomllib.loads(text))
        except UserError as error:
            where = f"{self.config_file}: {error.where}"
            raise UserError(error.what, where, error.remedy) from None
        except tomllib.TOMLDecodeError as error:
            what = f"the settings are not valid TOML ({error})"
            raise UserError(what, self.config_file, _GIVE_RUN) from None

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
        try:
            radiance, clip = float(facts["mean_radiance"]), bool(facts["clip_negative"])
            return Origin(str(facts["data"]), radiance, clip)
        except (ValueError, KeyError, TypeError):
            raise UserError("cannot be read", self.origin_file, again) from None

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
        texts = [text for text in read_text(file).splitlines() if text.strip()]
        lines = []
        for number, text in enumerate(texts, start=1):
            try:
                lines.append(json.loads(text))
            except ValueError as error:
                if number < len(texts):
                    raise UserError(f"line {number} is not JSON", file) from error
        return [line for line in lines if isinstance(line, dict)]

    def forget_after(self, step: int) -> None:
        """Drop the lines of the log after a step, and lines that a killed fit left half-written.

        A resumed fit takes those steps again.
        """
        log, kept = self.log_file, []
        lines = log.read_bytes().splitlines() if log.is_file() else ()
        for line in (line.decode("utf-8", "replace") for line in lines):
            try:
                if json.loads(line)["step"] <= step:
                    kept.append(line + "\n")
            except (ValueError, KeyError, TypeError):
                continue
        write_text(log, "".join(kept))

    def checkpoint(self, step: int) -> Path:
        """The file of the checkpoint after a number of steps."""
        return self.checkpoints / f"step-{step:07d}.safetensors"

    def written_checkpoints(self) -> list[Path]:
        """The existing checkpoints, the newest first."""
        return sorted(self.checkpoints.glob("step-*.safetensors"), reverse=True)

    def tidy_checkpoints(self) -> None:
        """Delete all but the newest checkpoints, and files that a killed fit left unfinished."""
        remove_unfinished(self.checkpoints)
        # Version 0.1 wrote checkpoints under this name before it renamed them.
        for old in [*self.written_checkpoints()[KEEP:], *self.checkpoints.glob("step-*.partial")]:
            old.unlink(missing_ok=True)

    def preview(self, step: int) -> Path:
        """The preview after a number of steps."""
        return self.previews / f"step-{step:06d}.png"

    # -------------------------------------------------------------------------- evaluation

    def picture(self, split: str, view: str, quantity: str, suffix: str = ".exr") -> Path:
        """The final picture of a quantity, such as "render" or "albedo", in a view.

        Args:
            split: of the view: "train" or "heldout".
            suffix: ".exr" (linear) or ".png" (for display).
        """
        return self.evaluation / split / f"{view}_{quantity}{suffix}"

    def environment(self, suffix: str = ".exr") -> Path:
        """The picture of the recovered environment map; `suffix` as in `picture`."""
        return self.evaluation / f"environment{suffix}"

    def metrics(self) -> dict[str, Any]:
        """The numbers of the evaluation.

        Raises:
            UserError: the run was not evaluated, or the file is damaged or of a newer version.
        """
        metrics = read_object(self.metrics_file, self.evaluate_again)
        check_format(metrics, METRICS_FORMAT, self.metrics_file)
        return metrics

    def write_metrics(self, metrics: Mapping[str, Any]) -> None:
        """Write the numbers of the evaluation."""
        write_json(self.metrics_file, metrics)

    @property
    def evaluate_again(self) -> str:
        """The remedy where an evaluation is missing or damaged."""
        return f"Run `unbake evaluate {self.path}`"
