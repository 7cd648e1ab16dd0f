"""The settings of a fit: frozen dataclasses, read from and written to TOML.

Every field cites the section of the paper (or says that the choice is ours). Unknown keys and wrong
types are errors, so that a misspelt setting is never silently ignored.
"""

from __future__ import annotations

import dataclasses
import json
import math
import sys
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from .errors import UserError
from .transport.methods import METHODS, Method

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Estimator = Literal["auto", "split-halves", "two-pass"]
Reference = Literal["smoothed", "photograph"]
PriorName = Literal["one-bounce", "extra-bounce"]
Unknown = Literal["materials", "lighting", "materials+lighting", "emission"]
Representation = Literal["neural", "grid", "bitmap"]
RadianceRepresentation = Literal["neural", "grid"]
Precision = Literal["single", "half"]
PresetName = Literal["cpu", "paper", "release"]

_FINEST = "base_resolution * growth^(levels - 1) is 2^24 or less"


@dataclass(frozen=True)
class GridConfig:
    """A multiresolution hash grid over the unit cube (Sec. 5.3; Müller et al. 2022)."""

    levels: int = 8  #: number of resolutions
    features: int = 2  #: features of each level
    table_log2: int = 15  #: log2 of the largest number of entries of a level
    base_resolution: int = 4  #: cells along an axis of the coarsest level
    growth: float = 2.0  #: ratio of resolutions of neighbouring levels

    def __post_init__(self) -> None:
        _check(self.levels >= 1, "levels", "1 or more", self.levels)
        _check(self.features in (2, 4, 8), "features", "2, 4 or 8", self.features)
        _check(4 <= self.table_log2 <= 28, "table_log2", "4 to 28", self.table_log2)
        _check(self.base_resolution >= 1, "base_resolution", "1 or more", self.base_resolution)
        _check(self.growth >= 1, "growth", "1 or more", self.growth)
        # Cells of a finer level than that are smaller than single precision tells positions apart.
        finest = math.log2(self.base_resolution) + (self.levels - 1) * math.log2(self.growth)
        _check(finest <= 24, "levels", f"such that {_FINEST}", self.levels)


@dataclass(frozen=True)
class NetworkConfig:
    """A multilayer perceptron on top of a hash grid (Sec. 5.3)."""

    grid: GridConfig = field(default_factory=GridConfig)
    width: int = 32  #: neurons of a hidden layer
    hidden: int = 2  #: number of hidden layers

    def __post_init__(self) -> None:
        for name in ("width", "hidden"):
            _check(getattr(self, name) >= 1, name, "1 or more", getattr(self, name))


@dataclass(frozen=True)
class TransportConfig:
    """How light is sampled (Sec. 4.2, 7)."""

    max_specular: int = 8  #: longest chain of mirrors, glass and cut-outs followed (Sec. 7)

    def __post_init__(self) -> None:
        _check(self.max_specular >= 0, "max_specular", "0 or more", self.max_specular)


@dataclass(frozen=True)
class PathConfig:
    """Paths of the methods that follow them to their end, `ad-pt` and `prb` (Sec. 6)."""

    max_depth: int = 15  #: longest path in bounces, plus one (Mitsuba's meaning)
    rr_depth: int = 5  #: bounces before Russian roulette, which goes on with 0.95 at most

    def __post_init__(self) -> None:
        for name in ("max_depth", "rr_depth"):
            _check(getattr(self, name) >= 1, name, "1 or more", getattr(self, name))


@dataclass(frozen=True)
class DenseGridConfig:
    """Dense 3D grids with trilinear interpolation over the scene's cube (Fig. 5)."""

    albedo: int = 64  #: cells along an axis
    roughness: int = 16  #: cells along an axis
    radiance: int = 32  #: cells along an axis; L_θ without direction, as in Fig. 5
    learning_rate: float = 0.1  #: Adam, albedo, in place of the networks' rate
    roughness_learning_rate: float = 0.025  #: Adam, roughness
    radiance_learning_rate: float = 0.05  #: Adam, radiance

    def __post_init__(self) -> None:
        for name in ("albedo", "roughness", "radiance"):
            _check(1 <= getattr(self, name) <= 512, name, "1 to 512", getattr(self, name))
        for name in ("learning_rate", "roughness_learning_rate", "radiance_learning_rate"):
            _check(getattr(self, name) > 0, name, "positive", getattr(self, name))


@dataclass(frozen=True)
class BitmapConfig:
    """Bitmaps in the UV coordinates of each material (Sec. 8)."""

    albedo: int = 128  #: pixels along an edge
    roughness: int = 32  #: pixels along an edge
    learning_rate: float = 0.15  #: Adam, albedo, in place of the networks' rate
    roughness_learning_rate: float = 0.04  #: Adam, roughness

    def __post_init__(self) -> None:
        for name in ("albedo", "roughness"):
            _check(1 <= getattr(self, name) <= 8192, name, "1 to 8192", getattr(self, name))
        for name in ("learning_rate", "roughness_learning_rate"):
            _check(getattr(self, name) > 0, name, "positive", getattr(self, name))


@dataclass(frozen=True)
class LightingConfig:
    """The unknown environment map and the unknown strength of lights (Sec. 5.1, Fig. 8).

    Where materials are unknown as well, the environment is never seen directly and no other light
    is known, albedo and light are known up to one factor a channel. It is then chosen such that the
    mean albedo of what the training views see is `mean_albedo`.
    """

    resolution: int = 64  #: texels along an edge of the square that the sphere is mapped to
    learning_rate: float = 0.02  #: Adam, log radiance
    mean_albedo: float = 0.5  #: the convention, each channel (ours)
    anchor: float = 1.0  #: weight of the squared deviation from it

    def __post_init__(self) -> None:
        known = self.resolution in (8, 16, 32, 64, 128, 256, 512)
        _check(known, "resolution", "8, 16, 32, 64, 128, 256 or 512", self.resolution)
        _check(0 < self.mean_albedo < 1, "mean_albedo", "between 0 and 1", self.mean_albedo)
        anchored = math.isfinite(self.anchor) and self.anchor >= 0
        _check(anchored, "anchor", "0 or more", self.anchor)
        _check(self.learning_rate > 0, "learning_rate", "positive", self.learning_rate)


@dataclass(frozen=True)
class RegularizationConfig:
    """What is believed of materials where photographs say little; all off by default (ours)."""

    roughness_smoothness: float = 0.0  #: weight of differences between near points
    radius: float = 0.02  #: how near, as a fraction of the scene's (or the bitmap's) edge
    albedo_ties_roughness: float = 0.0  #: weight of roughness differences at similar albedo
    similarity: float = 0.1  #: distance of albedos (linear RGB) that still count as similar

    def __post_init__(self) -> None:
        for name in ("roughness_smoothness", "albedo_ties_roughness"):
            value = getattr(self, name)
            _check(math.isfinite(value) and value >= 0, name, "0 or more", value)
        for name in ("radius", "similarity"):
            value = getattr(self, name)
            _check(math.isfinite(value) and value > 0, name, "positive", value)


#: Bounces that can be differentiated before the radiance field takes over.
MOST_BOUNCES = 16


@dataclass(frozen=True)
class FitConfig:
    """Everything that decides what a fit does, apart from its data set."""

    preset: PresetName = "cpu"
    unknown: Unknown = "materials"
    method: str = "ours"  #: see `transport/methods.py`
    bounces: int = 1  #: differentiable bounces before L_θ is asked (Sec. 6.3); `ours` only
    prior: PriorName = "extra-bounce"  #: where the residual is taken (Sec. 4.2); `ours` only
    representation: Representation = "neural"  #: of the materials (Sec. 5.1, Fig. 5, Sec. 8)
    radiance_representation: RadianceRepresentation = "neural"  #: of L_θ (Sec. 5.3, Fig. 5)
    seed: int = 0

    steps: int = 2400  #: training steps (Table 1)
    seconds: float = 0.0  #: stop after this much training time instead (0: count steps)
    pixels: int = 1024  #: batch size in pixels (Table 1)
    spp: int = 8  #: camera samples a pixel a step (Table 1); even, for the split halves
    radiance_spp: int = 2  #: how many of these L_θ learns of, too; even (ours; 0: all)

    learning_rate: float = 0.015  #: Adam, albedo network (Sec. 5.4: 5e-4)
    roughness_learning_rate: float = 0.004  #: Adam, roughness network (Sec. 5.4: 5e-4)
    radiance_learning_rate: float = 0.01  #: Adam, radiance network (Sec. 5.4: 5e-4)
    final_learning_rate: float = 0.05  #: factor reached at the end, exponentially (1: constant)
    warm_up: int = 100  #: steps over which the materials' rate rises, so that L_θ stays ahead
    estimator: Estimator = "auto"  #: unbiased squared error (Sec. 5.2); see `halves`
    loss_reference: Reference = "smoothed"  #: what errors are relative to (Sec. 5.4: photograph)
    loss_epsilon: float = 0.001  #: added to the denominator of the relative L2 loss (release: 0.01)

    albedo: NetworkConfig = field(default_factory=lambda: NetworkConfig(GridConfig(7), hidden=1))
    roughness: NetworkConfig = field(default_factory=lambda: NetworkConfig(GridConfig(4), 16, 1))
    radiance: NetworkConfig = field(default_factory=lambda: NetworkConfig(GridConfig(6)))
    precision: Precision = "single"  #: of the networks' products; all else is single (ours)
    grid: DenseGridConfig = field(default_factory=DenseGridConfig)
    bitmap: BitmapConfig = field(default_factory=BitmapConfig)
    lighting: LightingConfig = field(default_factory=LightingConfig)
    regularization: RegularizationConfig = field(default_factory=RegularizationConfig)
    transport: TransportConfig = field(default_factory=TransportConfig)
    path: PathConfig = field(default_factory=PathConfig)

    checkpoint_seconds: float = 60.0  #: time between checkpoints
    preview_seconds: float = 30.0  #: time between preview pictures
    score_seconds: float = 0.0  #: time between scores on all held-out views (0: never)

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, float):
                _check(math.isfinite(value), name, "a finite number", value)
        _check(self.spp >= 2 and self.spp % 2 == 0, "spp", "an even number, 2 or more", self.spp)
        few = self.radiance_spp
        _check(few >= 0 and few % 2 == 0, "radiance_spp", "an even number, 0 or more", few)
        for name in ("steps", "pixels"):
            _check(getattr(self, name) >= 1, name, "1 or more", getattr(self, name))
        rates = ("learning_rate", "roughness_learning_rate", "radiance_learning_rate")
        for name in (*rates, "final_learning_rate"):
            _check(getattr(self, name) > 0, name, "positive", getattr(self, name))
        times = ("seconds", "checkpoint_seconds", "preview_seconds", "score_seconds")
        for name in (*times, "warm_up", "seed"):
            _check(getattr(self, name) >= 0, name, "0 or more", getattr(self, name))
        _check(self.loss_epsilon > 0, "loss_epsilon", "positive", self.loss_epsilon)
        _check(
            1 <= self.bounces <= MOST_BOUNCES,
            "bounces",
            f"1 to {MOST_BOUNCES} (every bounce is kept in memory; prb follows longer paths)",
            self.bounces,
        )
        _check(self.method in METHODS, "method", f"one of {', '.join(METHODS)}", self.method)
        if not METHODS[self.method].takes_options:
            _check(self.bounces == 1, "bounces", f"1 for the method {self.method}", self.bounces)
            only = f"extra-bounce for the method {self.method}"
            _check(self.prior == "extra-bounce", "prior", only, self.prior)

    @property
    def halves(self) -> bool:
        """Whether squared errors come from split halves of a pixel's samples.

        With `estimator = "auto"` every method has its usual one: split halves in one pass for ours
        and its ablations, two decorrelated passes for `ad-pt` and `prb`, as in Mitsuba.
        """
        if self.estimator == "auto":
            return not self.follows_paths
        return self.estimator == "split-halves"

    @property
    def half_precision(self) -> bool:
        """Whether networks multiply in half precision."""
        return self.precision == "half"

    @property
    def follows_paths(self) -> bool:
        """Whether the method follows paths to their end, and has no radiance field."""
        return METHODS[self.method].follows_paths

    @property
    def chosen_method(self) -> Method:
        """The method, with its residuals where `prior` says."""
        method = METHODS[self.method]
        return method.without_extra_bounce() if self.prior == "one-bounce" else method

    @property
    def learns_materials(self) -> bool:
        """Whether albedo and roughness are unknown."""
        return self.unknown in ("materials", "materials+lighting")

    @property
    def learns_environment(self) -> bool:
        """Whether the environment map is unknown."""
        return self.unknown in ("lighting", "materials+lighting")

    @property
    def radiance_samples(self) -> int:
        """Camera samples a pixel that L_θ learns of."""
        return min(self.radiance_spp or self.spp, self.spp)

    @property
    def samples_per_step(self) -> int:
        """Camera samples of a training step."""
        return self.pixels * self.spp


def _check(good: bool, key: str, wanted: str, value: object) -> None:
    if not good:
        raise UserError(f"must be {wanted}, not {value!r}", where=key)


def _paper() -> FitConfig:
    """Sec. 5.3, 5.4 and Table 1 (STAIRCASE): resolutions 2^1 … 2^16, table 2^17, Adam 5e-4."""
    grid = GridConfig(levels=16, features=2, table_log2=17, base_resolution=2, growth=2.0)
    return FitConfig(
        preset="paper",
        steps=18_000,
        pixels=16_384,
        spp=16,
        radiance_spp=0,
        learning_rate=5e-4,
        roughness_learning_rate=5e-4,
        radiance_learning_rate=5e-4,
        final_learning_rate=1.0,
        warm_up=0,
        estimator="two-pass",
        loss_reference="photograph",
        loss_epsilon=0.01,
        albedo=NetworkConfig(grid=grid, width=256, hidden=1),
        roughness=NetworkConfig(grid=grid, width=256, hidden=1),
        radiance=NetworkConfig(grid=grid, width=256, hidden=3),
    )


def _release() -> FitConfig:
    """The settings of the authors' public release: 17 levels, base 2, scale 1.5, table 2^18."""
    grid = GridConfig(levels=17, features=2, table_log2=18, base_resolution=2, growth=1.5)
    return dataclasses.replace(
        _paper(),
        preset="release",
        albedo=NetworkConfig(grid=grid, width=256, hidden=1),
        roughness=NetworkConfig(grid=grid, width=256, hidden=1),
        radiance=NetworkConfig(grid=grid, width=256, hidden=3),
    )


def preset(name: PresetName) -> FitConfig:
    """The settings of a preset: `cpu` (ours, two cores), `paper` (Sec. 5) or `release`."""
    match name:
        case "cpu":
            return FitConfig()
        case "paper":
            return _paper()
        case "release":
            return _release()
    raise UserError(f"no preset named {name!r}", remedy="Presets are cpu, paper and release")


# --------------------------------------------------------------------------------------------- TOML


def to_toml(config: FitConfig) -> str:
    """The settings as TOML text; `from_toml` gives the same settings back."""
    lines: list[str] = []
    _write_table(dataclasses.asdict(config), (), lines)
    return "\n".join(lines).strip() + "\n"


def _write_table(table: dict, path: tuple[str, ...], lines: list[str]) -> None:
    if path:
        lines += ["", f"[{'.'.join(path)}]"]
    for key, value in table.items():
        if not isinstance(value, dict):
            lines.append(f"{key} = {json.dumps(value)}")
    for key, value in table.items():
        if isinstance(value, dict):
            _write_table(value, (*path, key), lines)


def from_toml(text: str, where: str = "settings") -> FitConfig:
    """Settings from TOML text; keys that are absent keep the value of the named preset.

    Raises:
        UserError: the text is not TOML, a key is unknown, or a value has the wrong type or range.
    """
    try:
        table = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"not valid TOML ({error})", where=where) from None
    try:
        # Version 0.1 spelled it the British way.
        if "regularisation" in table:
            table["regularization"] = table.pop("regularisation")
        name = _typed(table.get("preset", "cpu"), PresetName, "preset")
        return _update(preset(name), table, ())
    except UserError as error:
        raise UserError(error.what, where=f"{where}: {error.where}", remedy=error.remedy) from None


def read_toml(path: Path) -> FitConfig:
    """Settings from a TOML file; see `from_toml`."""
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot be read ({error.strerror})", path, "Check the path") from None
    except UnicodeDecodeError:
        raise UserError("is not UTF-8 text", path, "Save it as UTF-8") from None
    return from_toml(text, str(path))


def _update(config, table: dict, path: tuple[str, ...]):
    hints = typing.get_type_hints(type(config))
    changes = {}
    for key, value in table.items():
        dotted = ".".join((*path, key))
        if key not in hints:
            known = ", ".join(hints)
            raise UserError("unknown key", where=dotted, remedy=f"Known keys: {known}")
        current = getattr(config, key)
        if dataclasses.is_dataclass(current):
            if not isinstance(value, dict):
                raise UserError("must be a table", where=dotted)
            changes[key] = _update(current, value, (*path, key))
        else:
            changes[key] = _typed(value, hints[key], dotted)
    try:
        return dataclasses.replace(config, **changes)
    except UserError as error:
        raise UserError(error.what, ".".join((*path, str(error.where))), error.remedy) from None


def _typed(value: object, hint: type, where: str) -> object:
    if typing.get_origin(hint) in (Literal, types.UnionType):
        choices = typing.get_args(hint)
        if value not in choices:
            raise UserError(f"must be one of {', '.join(choices)}, not {value!r}", where=where)
        return value
    if hint is float and type(value) is int and abs(value) < 1 << 53:
        return float(value)
    if type(value) is not hint:
        raise UserError(f"must be {hint.__name__}, not {type(value).__name__}", where=where)
    return value
