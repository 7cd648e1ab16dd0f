"""The settings of a fit, as frozen dataclasses.

Fields cite the section of the paper, or say that the choice is ours, where one was made.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

from ..errors import (
    POSITIVE,
    UserError,
    mistyped,
    plain,
    require,
    require_name,
    require_ranges,
)
from ..fields.grid_sizes import USUAL, sized
from ..fields.registry import representation, representations
from ..fields.settings import RATES, FieldSettings, GuideConfig, require_no_pieces
from ..quantities import DEFAULT_QUANTITIES, QUANTITIES, in_order, quantity
from ..transport.methods import KEPT_PATHS, METHODS, PATH_REPLAY, Method
from .camera import CameraConfig
from .flag import Flag
from .objective import ObjectiveConfig
from .roughness_search import RoughnessSearchConfig
from .tables import update

ChosenEstimator = Literal["all-pairs", "split-halves", "two-pass"]
Estimator = Literal["auto", ChosenEstimator]
Reference = Literal["smoothed", "photograph"]
PixelSampling = Literal["all-views", "one-view-crop"]
PriorName = Literal["one-bounce", "extra-bounce"]
Unknown = Literal[
    "auto",
    "materials",
    "lighting",
    "emission",
    "materials+lighting",
    "materials+emission",
    "lighting+emission",
    "materials+lighting+emission",
]
Lamps = Literal["known", "fitted"]
LampPictures = Literal["known", "ignored"]
ScaleToldBy = Literal["pixels", "background"]
MeanColour = Literal["photographs", "grey"]
Precision = Literal["single", "half"]
PresetName = Literal["cpu", "paper", "release", "release-lighting"]


#: The longest paths that can be asked for.
DEEPEST = 10_000
#: The longest paths that can be kept in memory, each bounce with a kernel of its own: with 256, the
#: first step compiled for two minutes on two cores.
DEEPEST_KEPT = 256
#: Counts and times that no fit reaches: a billion steps, or seconds.
_ENDLESS = 10**9
#: The most camera samples of a pass: an array of Dr.Jit has fewer than 2^32 entries, and products
#: of matrices have one for each sample and neuron.
MOST_SAMPLES = 1 << 26


@dataclass(frozen=True)
class TransportConfig:
    """How light is sampled (Sec. 4.2, 7)."""

    max_specular: int = 8  #: longest chain of mirrors, glass and cut-outs followed (Sec. 7)

    def __post_init__(self) -> None:
        require_ranges(self, {"max_specular": (0, DEEPEST)})


#: Steps between readings of the loss; reading waits for the machine.
READ_EVERY = 20
#: The depth of paths in the paper (Sec. 6).
PAPER_DEPTH = 15


@dataclass(frozen=True)
class PathConfig:
    """Paths of the methods that follow them to their end, such as `prb` (Sec. 6)."""

    #: Longest path in bounces, plus one (Mitsuba's meaning); 0: see `chosen_depth`. What shorter
    #: paths leave out is explained by wrong materials.
    max_depth: Annotated[
        int,
        Flag(
            "Longest path of methods that follow whole paths, such as prb; 0: the depth that "
            "carries 99 % of the light, as the data set says, but at least 15"
        ),
    ] = 0
    #: Russian roulette, which goes on with 0.95 at most. With 5, `prb` (Mitsuba 3.9.1) loses the
    #: seventh interaction at the earliest, and `ad-pt` the sixth.
    rr_depth: int = 5
    #: The wavefront of `ad-pt` is planned, before the first step, for surfaces that reflect so many
    #: times as much as they do then: untrained albedo is 0.5, that of walls 0.8. Where they reflect
    #: more than was planned for, fewer paths survive, and count more; where less, lanes stay empty.
    #: 0: `GAIN_OF_ROOMS` in rooms; around objects, where hardly any path is long, 1.
    planned_gain: float = 0.0

    def __post_init__(self) -> None:
        require_ranges(self, {"max_depth": (0, DEEPEST), "rr_depth": (1, DEEPEST)})
        require_ranges(self, {"planned_gain": (1 if self.planned_gain else 0, 10)})

    @property
    def chosen_depth(self) -> int:
        """The depth of paths: `max_depth`, or that of the paper where it is left open.

        `training.path_depth.with_path_depth` puts the depth of a data set into settings that leave
        it open.
        """
        return self.max_depth or PAPER_DEPTH


@dataclass(frozen=True)
class LightingConfig:
    """The unknown environment map and the unknown strength of lights (Sec. 5.1, Fig. 8).

    Where materials are unknown as well, no photograph shows unknown light and no other light is
    known, albedo and light are known up to one factor a channel, but for what light between
    surfaces tells. A fit then begins such that the mean albedo of what the training views see has
    the mean `mean_albedo`, and the `mean_colour`, and keeps to it as far as nothing else tells.
    """

    #: Texels along an edge of the square that the sphere is mapped to. An edge of n has 2n texels
    #: around the horizon, as an image of 2n x n pixels has.
    resolution: int = 64
    learning_rate: float = 0.02  #: Adam, log radiance
    #: How many times as fast the levels of 4 and 8 texels along an edge learn, where materials are
    #: unknown as well (ours).
    coarse_gain: float = 4.0
    #: Radiance of the map at the start, W·sr⁻¹·m⁻²; 0: the level of the photographs (ours).
    initial_radiance: float = 0.0
    mean_albedo: float = 0.5  #: the convention, mean over channels, less if one is above 0.8 (ours)
    #: Its colour: of the photographs, as if light were white, or grey, as if surfaces were (ours).
    mean_colour: MeanColour = "photographs"
    anchor: float = 1.0  #: weight of the squared deviation from it, in the first tenth of a fit
    #: The same in its second half, and never more than the first. In between it falls: light
    #: between surfaces tells of the factor as well, and is heard once materials are near where they
    #: belong (ours).
    final_anchor: float = 0.003
    #: What tells the factor instead. pixels: those to train on that show unknown light, directly or
    #: in mirrors and glass, and are not clipped; background: any that is visible, and no mirror
    #: (ours).
    scale_told_by: ScaleToldBy = "pixels"

    def __post_init__(self) -> None:
        # The map is up to e^20 times as bright as it starts: `fields/envmap.py`.
        ranges = {"initial_radiance": (0, 1e20), "learning_rate": RATES}
        ranges |= {"coarse_gain": (POSITIVE, 1e3)}
        require_ranges(self, ranges | dict.fromkeys(("anchor", "final_anchor"), (0, 1e6)))
        known = self.resolution in (8, 16, 32, 64, 128, 256, 512)
        require(known, "resolution", "8, 16, 32, 64, 128, 256 or 512", self.resolution)
        require(0 < self.mean_albedo < 1, "mean_albedo", "between 0 and 1", self.mean_albedo)


@dataclass(frozen=True)
class RegularizationConfig:
    """Regularizers of materials, for few or noisy photographs (ours).

    Those of roughness are off by default. That of albedo weighs as much as photographs are noisy:
    next to nothing where they are clean.
    """

    roughness_smoothness: float = 0.0  #: weight of differences between near points
    radius: float = 0.02  #: how near, as a fraction of the scene's (or the bitmap's) edge
    albedo_ties_roughness: float = 0.0  #: weight of roughness differences at similar albedo
    similarity: float = 0.1  #: distance of albedos (linear RGB) that still count as similar
    albedo_smoothness: float = 3.5  #: weight of albedo differences, times the photometric loss
    albedo_radius: float = 0.0  #: how near, like `radius`; 0: a pixel of the training views

    def __post_init__(self) -> None:
        weight, distance = (0, 1e6), (POSITIVE, 1e3)
        require_ranges(
            self,
            {
                "roughness_smoothness": weight,
                "albedo_ties_roughness": weight,
                "radius": distance,
                "similarity": distance,
                "albedo_smoothness": weight,
                "albedo_radius": (0, 1e3),
            },
        )


#: What a fit can recover, each with a learning rate of its own.
UNKNOWNS = (*QUANTITIES, "environment", "emission")

#: Level below which photographs are dim: the darkest of the published scenes has more.
DIM = 0.08


def dimmed(epsilon: float, level: float) -> float:
    """What is added to squared radiance, which falls with the square of a level below `DIM`.

    Args:
        epsilon: where the level is larger.
        level: mean radiance, linear RGB.
    """
    return epsilon * (level / DIM) ** 2 if 0 < level < DIM else epsilon


#: How many times as much as untrained ones the surfaces of rooms are planned to reflect.
GAIN_OF_ROOMS = 1.6

#: Schedule of methods for which no other one was found best.
OWN_FINAL_RATE, OWN_WARM_UP = 0.05, 100
#: Least slope of the bounds of albedo, of methods with L_θ; others have none.
LEAST_SLOPE = 0.01
#: Adam's first β₂ for the unknowns of methods with L_θ, and that of all others. Where roughness
#: is not searched for, noise moves it farther with the shorter memory.
FORGETFUL_BETA2, OWN_BETA2 = 0.99, 0.999

#: Bounces that can be differentiated before the radiance field takes over.
MOST_BOUNCES = 16
#: Those that a fit chooses for an object. Most of its light comes from outside, so that a second
#: bounce costs little, and L_θ matters less. In rooms there is one, as in the paper.
BOUNCES_OF_OBJECTS = 2


# Choices for the help of the command line, from the tables that settings name rows of.


def _quantities() -> dict[str, str]:
    return {name: row.title.lower() for name, row in QUANTITIES.items()}


def _methods() -> dict[str, str]:
    return {name: method.title for name, method in METHODS.items()}


def _representations() -> dict[str, str]:
    return {name: representation(name).title for name in representations()}


def _of_radiance() -> dict[str, str]:
    return {name: representation(name).title for name in representations(radiance=True)}


@dataclass(frozen=True)
class FitConfig:
    """Everything that decides what a fit does, apart from its data set."""

    preset: PresetName = "cpu"
    unknown: Annotated[
        Unknown,
        Flag(
            "What to recover: materials (the --quantities), lighting (the environment map), "
            "emission (colour and strength of the lights), several of them, as in "
            "materials+lighting or materials+emission, or auto: materials, and all light with "
            "them where the data set says that it is unknown",
            metavar="WHAT",
        ),
    ] = "auto"
    #: Of materials (Sec. 5.1).
    quantities: Annotated[
        tuple[str, ...],
        Flag(
            "What is unknown of materials, one or more of these",
            metavar="NAME",
            choices=_quantities,
        ),
    ] = DEFAULT_QUANTITIES
    #: A row of the table in `transport/methods.py`.
    method: Annotated[
        str,
        Flag(
            "Method",
            metavar="METHOD",
            choices=_methods,
        ),
    ] = "ours"
    #: k of Sec. 6.3, of methods with L_θ along one bounce or a few; 0: see `chosen_bounces`.
    bounces: Annotated[
        int,
        Flag(
            "Differentiable bounces of ours and no-prior before the radiance field; 0: 2 where "
            "photographs hide the background, else 1"
        ),
    ] = 0
    #: Sec. 4.2; `ours` only.
    prior: Annotated[
        PriorName, Flag("Where ours takes the residual: extra-bounce is at x2 as well as at x1")
    ] = "extra-bounce"
    #: Of the materials (Sec. 5.1, Fig. 5, Sec. 8).
    representation: Annotated[
        str,
        Flag(
            "How materials are represented",
            metavar="NAME",
            choices=_representations,
        ),
    ] = "neural"
    #: Of L_θ (Sec. 5.3, Fig. 5).
    radiance_representation: Annotated[
        str,
        Flag(
            "How the radiance field is represented",
            name="radiance",
            metavar="NAME",
            choices=_of_radiance,
        ),
    ] = "neural"
    seed: Annotated[int, Flag("Seed of weights and samples")] = 0

    #: Table 1.
    steps: Annotated[
        int, Flag("Length of the fit in training steps; with 0 the fields stay untrained")
    ] = 2400
    #: Stop after this much training time instead (0: count steps).
    seconds: Annotated[
        float,
        Flag(
            "Length of the fit in seconds of training, instead of steps",
            metavar="SECONDS",
            tell_default=False,
        ),
    ] = 0.0
    #: Batch size in pixels (Table 1), of all processes of a fit together.
    pixels: Annotated[
        int, Flag("Pixels in a step; with mpiexec, of all processes together", name="batch")
    ] = 1024
    #: Steps that each of several ranks takes by itself before their states are averaged (local SGD;
    #: ours). 1: gradients are averaged in each step.
    sync_every: Annotated[
        int,
        Flag(
            "With mpiexec: steps that each process takes by itself, until all average what they "
            "learned, 20 at most; for slow networks. 1: they take every step together",
            metavar="STEPS",
        ),
    ] = 1
    #: Which pixels: random ones of all views (ours), or a random crop of a random view, half of it
    #: foreground at least (Sec. 5.4). A crop is as near to a square as its pixels allow.
    pixel_sampling: Annotated[
        PixelSampling, Flag("Where the pixels of a step lie: anywhere, or in one crop of one view")
    ] = "all-views"
    #: Pixels that no step draws, for the error that is measured on them (ours).
    held_aside: Annotated[
        float,
        Flag(
            "Share of the training pixels that no step draws, 4096 at most: the error on these "
            "tells how the fit goes; 0: none",
            metavar="SHARE",
        ),
    ] = 0.02
    #: Camera samples a pixel a step (Table 1); even: errors held aside, and some squared ones, come
    #: from two halves.
    spp: Annotated[int, Flag("Samples per pixel in a step, an even number")] = 8
    radiance_spp: int = 2  #: how many of these L_θ learns of, too; even (ours; 0: all)

    #: Factor reached at the end, exponentially (1: constant). None: what was found best for the
    #: method, else `OWN_FINAL_RATE`; a run that was started has a number.
    final_learning_rate: float | None = None
    #: Multiples of the fields' learning rates, by unknown. None: what was found best for the method
    #: and the kind of scene (`method_defaults.py`; ours); a run that was started has numbers.
    rate_factors: Mapping[str, float | None] = field(default_factory=dict)
    #: Steps over which the unknowns' rates rise (ours). None: what was found best for the method,
    #: else `OWN_WARM_UP`, so that L_θ stays ahead, and none without L_θ.
    warm_up: int | None = None
    #: Adam's first β₂ for the unknowns: how long it remembers the squares of gradients (ours).
    #: Those of the first steps may be a hundred times as large as later ones. It grows with the
    #: steps to `OWN_BETA2`, the usual one (`training/adam.py`). 0: `FORGETFUL_BETA2` with L_θ, and
    #: `OWN_BETA2` without; a run that was started has a number.
    beta2: float = 0.0
    #: Unbiased squared error (Sec. 5.2). auto: what was found best for the method; see
    #: `chosen_estimator`.
    estimator: Estimator = "auto"
    loss_reference: Reference = "smoothed"  #: what errors are relative to (Sec. 5.4: photograph)
    #: Added to the denominator of the relative L2 loss (release: 0.01), see `epsilon`.
    loss_epsilon: float = 0.001

    #: Whether materials that lamps alone have stay as the scene gives them (ours).
    lamps: Lamps = "known"
    #: Whether lamps whose strength is fitted keep the picture that the scene gives them (ours):
    #: their strength is its mean. ignored: they have one colour.
    lamp_pictures: LampPictures = "known"
    #: Of the fields, by quantity and representation (Sec. 5.3); what is not given has its default.
    materials: Mapping[str, Mapping[str, FieldSettings]] = field(default_factory=dict)
    #: Lower bound on the slope of albedo's sigmoid in gradients (ours; `fields/arrays.py`). With
    #: 0, values that the first steps drive into saturation recover slowly or never. -1:
    #: `LEAST_SLOPE` with L_θ, and 0 without; a run that was started has a number.
    least_slope: float = -1.0
    #: Of L_θ, by representation (Sec. 5.3).
    radiance: Mapping[str, FieldSettings] = field(default_factory=dict)
    #: Path guiding of methods with L_θ (ours).
    guide: GuideConfig = field(default_factory=GuideConfig)
    precision: Precision = "single"  #: of the networks' products; all else is single (ours)
    lighting: LightingConfig = field(default_factory=LightingConfig)
    regularization: RegularizationConfig = field(default_factory=RegularizationConfig)
    transport: TransportConfig = field(default_factory=TransportConfig)
    path: PathConfig = field(default_factory=PathConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    objective: ObjectiveConfig = field(default_factory=ObjectiveConfig)
    roughness_search: RoughnessSearchConfig = field(default_factory=RoughnessSearchConfig)

    checkpoint_seconds: float = 60.0  #: time between checkpoints
    preview_seconds: float = 30.0  #: time between preview pictures
    score_seconds: float = 0.0  #: time between scores on all held-out views (0: never)

    def __post_init__(self) -> None:
        times = ("seconds", "checkpoint_seconds", "preview_seconds", "score_seconds")
        require_ranges(
            self,
            dict.fromkeys((*times, "steps", "warm_up"), (0, _ENDLESS))
            | {
                "seed": (0, (1 << 63) - 1),  # as TOML has them
                "pixels": (1, MOST_SAMPLES),
                "sync_every": (1, READ_EVERY),  # what is told is of one state
                "held_aside": (0, 0.5),
                "beta2": (0, 0.99999),
                "least_slope": (-1, 0.25),  # that of the middle
                "final_learning_rate": (POSITIVE, 1e3),
                "loss_epsilon": (1e-12, 1e20),  # its inverse is a weight, in single precision
            },
        )
        require(self.spp >= 2 and self.spp % 2 == 0, "spp", "an even number, 2 or more", self.spp)
        few = self.radiance_spp
        require(few >= 0 and few % 2 == 0, "radiance_spp", "an even number, 0 or more", few)
        if self.samples_per_pass > MOST_SAMPLES:
            what = f"pixels * spp must be {MOST_SAMPLES} or less, not {self.samples_per_pass}"
            pixels, spp = MOST_SAMPLES // self.spp, MOST_SAMPLES // self.pixels // 2 * 2
            fewer = [f"pixels (--batch) to {pixels}"] if pixels else []
            fewer += [f"spp to {spp}"] if spp else []
            raise UserError(what, "pixels", f"Lower {' or '.join(fewer)}")
        require(
            0 <= self.bounces <= MOST_BOUNCES,
            "bounces",
            f"0 to {MOST_BOUNCES} (every bounce is kept in memory; prb follows longer paths)",
            self.bounces,
        )
        require(self.method in METHODS, "method", f"one of {', '.join(METHODS)}", self.method)
        method, of_method = METHODS[self.method], f"for the method {self.method}"
        if not method.takes_bounces:
            require(self.bounces in (0, 1), "bounces", f"1 {of_method}", self.bounces)
        if not method.takes_prior:
            only = f"extra-bounce {of_method}"
            require(self.prior == "extra-bounce", "prior", only, self.prior)
        if self.estimator == "all-pairs":
            wanted = (
                f"split-halves or two-pass for the method {self.method}, whose samples of a pixel "
                "are independent in two halves only"
            )
            require(self.one_pass == "all-pairs", "estimator", wanted, self.estimator)
        if self.follows_paths:
            self._check_depth()
        self._complete_fields()

    def _check_depth(self) -> None:
        """Check the depth of paths that are followed to their end."""
        depth, of_method = self.path.max_depth, f"for the method {self.method}"
        few = f"2 or more {of_method}: shorter paths meet no material"
        require(depth != 1, "path.max_depth", few, depth)
        if METHODS[self.method].sampler != PATH_REPLAY:
            kept = (
                f"{DEEPEST_KEPT} or less {of_method}, which keeps paths (prb follows longer ones)"
            )
            require(depth <= DEEPEST_KEPT, "path.max_depth", kept, depth)

    def _complete_fields(self) -> None:
        """Check quantities and representations, and fill in the field settings not given."""
        names = self.quantities
        a_tuple = isinstance(names, Collection) and not isinstance(names, str)
        a_tuple = a_tuple and all(isinstance(name, str) for name in names)
        require(a_tuple, "quantities", "a tuple of names", names)
        for key in ("rate_factors", "materials", "radiance"):
            value = getattr(self, key)
            require(isinstance(value, Mapping), key, "a dictionary", value)
        try:
            chosen = in_order(self.quantities)
        except UserError as error:
            raise UserError(error.what, "quantities", error.remedy) from None
        ties, r = {"roughness"}, self.regularization
        if r.albedo_ties_roughness:
            ties.add("albedo")
        if self.learns_materials and (r.roughness_smoothness or r.albedo_ties_roughness):
            wanted = f"{' and '.join(sorted(ties))} at least, as [regularization] says"
            require(ties <= set(chosen), "quantities", wanted, ", ".join(chosen))
        for key, names in (
            ("representation", representations()),
            ("radiance_representation", representations(radiance=True)),
        ):
            value = getattr(self, key)
            require(value in names, key, f"one of {', '.join(names)}", value)
        materials = {
            name: _completed(
                f"materials.{name}",
                self.materials.get(name, {}),
                {form: default_settings(name, form) for form in representations()},
            )
            for name in [*QUANTITIES, *self.materials]
            if quantity(name)
        }
        factors = dict(self.rate_factors)
        for name, factor in factors.items():
            require_name(name, UNKNOWNS, "unknown", "rate_factors")
            factors[name] = factor = plain(factor)
            good = mistyped(factor, float | None) is None and (factor is None or 0 < factor <= 1e4)
            require(good, f"rate_factors.{name}", "positive and 10000 or less", factor)
        factors = {name: factors.get(name) for name in UNKNOWNS}
        of_radiance = {form: representation(form).radiance for form in representations()}
        radiance = _completed(
            "radiance", self.radiance, {f: s for f, s in of_radiance.items() if s}
        )
        for form, settings in radiance.items():
            require_no_pieces(settings, f"radiance.{form}")
        # Frozen: the completed settings take the place of what was given.
        for key, value in (
            ("quantities", chosen),
            ("rate_factors", factors),
            ("materials", materials),
            ("radiance", radiance),
        ):
            object.__setattr__(self, key, value)

    def epsilon(self, level: float) -> float:
        """What is added to the denominator of the relative L2 loss (ours).

        Where photographs are darker than `DIM`, it falls with the square of their level, so that
        errors stay relative, and such a fit does not depend on the unit of light. The presets of
        the paper and of its authors add the same to all.

        Args:
            level: of the photographs, radiance; see `Photographs`.
        """
        return dimmed(self.loss_epsilon, level) if self.preset == "cpu" else self.loss_epsilon

    @property
    def chosen_estimator(self) -> ChosenEstimator:
        """The estimator of squared errors.

        With `estimator = "auto"`, as runs of earlier versions may have it, squared errors come from
        split halves of a pixel's samples, but for methods that follow paths. A fit that starts
        chooses the one that was found best.
        """
        if self.estimator == "auto":
            return "two-pass" if self.follows_paths else "split-halves"
        return self.estimator

    @property
    def chosen_bounces(self) -> int:
        """Differentiable bounces before L_θ is asked.

        With `bounces = 0` there is one. A fit that starts chooses by the kind of scene where the
        settings leave it open; see `training.defaults.with_method_defaults`.
        """
        return self.bounces or 1

    @property
    def one_pass(self) -> ChosenEstimator:
        """The best estimator of the method that takes one pass.

        That is all pairs, but for methods that keep paths: their wavefront narrows by systematic
        sampling, so that samples of a pixel are independent in two halves only.
        """
        return "split-halves" if METHODS[self.method].sampler == KEPT_PATHS else "all-pairs"

    @property
    def two_passes(self) -> bool:
        """Whether a step traces every pixel twice, for squared errors from two passes."""
        return self.chosen_estimator == "two-pass"

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
        """Whether quantities of the materials are unknown.

        So they are with `unknown = "auto"`, which a fit that starts replaces by what the data set
        says.
        """
        return self.unknown == "auto" or "materials" in self._unknown_parts

    @property
    def learns_environment(self) -> bool:
        """Whether the environment map is unknown."""
        return "lighting" in self._unknown_parts

    @property
    def learns_emission(self) -> bool:
        """Whether the strengths of lights are unknown."""
        return "emission" in self._unknown_parts

    @property
    def _unknown_parts(self) -> Sequence[str]:
        return self.unknown.split("+")

    @property
    def shares_scale(self) -> bool:
        """Whether albedo and light are both unknown, and may share an open factor."""
        light = self.learns_environment or self.learns_emission
        return light and self.learns_materials and "albedo" in self.quantities

    @property
    def unknowns(self) -> tuple[str, ...]:
        """What is recovered: names of `UNKNOWNS`."""
        found = self.quantities if self.learns_materials else ()
        lights = {"environment": self.learns_environment, "emission": self.learns_emission}
        return (*found, *(name for name, learned in lights.items() if learned))

    @property
    def material_settings(self) -> dict[str, FieldSettings]:
        """Settings of the chosen representation, by unknown quantity.

        Sizes of hash grids that are left open are the usual ones; a fit that starts chooses those
        of its data set (`training.grid_sizes.with_grid_sizes`).
        """
        return {
            name: sized(self.materials[name][self.representation], USUAL)
            for name in self.quantities
        }

    @property
    def radiance_settings(self) -> FieldSettings:
        """Settings of the chosen representation of L_θ; sizes as in `material_settings`."""
        return sized(self.radiance[self.radiance_representation], USUAL)

    @property
    def radiance_samples(self) -> int:
        """Camera samples a pixel that L_θ learns of."""
        return min(self.radiance_spp or self.spp, self.spp)

    @property
    def samples_per_pass(self) -> int:
        """Camera samples that one pass of a training step traces at once."""
        return self.pixels * self.spp

    @property
    def samples_per_step(self) -> int:
        """Camera samples that a training step traces, in all its passes."""
        return self.samples_per_pass * (2 if self.two_passes else 1)


def default_settings(name: str, form: str) -> FieldSettings:
    """The default settings of a quantity's field.

    Args:
        name: of the quantity.
        form: name of the representation.
    """
    return update(representation(form).settings, quantity(name).settings.get(form, {}))


def _completed(
    key: str, given: Mapping[str, FieldSettings], defaults: Mapping[str, FieldSettings]
) -> dict[str, FieldSettings]:
    """The settings given and the defaults of the others, by representation.

    Args:
        key: their name.
    """
    require(isinstance(given, Mapping), key, "a dictionary", given)
    for form, settings in given.items():
        require_name(form, defaults, "representation", key)
        kind = type(defaults[form])
        require(type(settings) is kind, f"{key}.{form}", f"a {kind.__name__}", settings)
    return {**defaults, **given}
