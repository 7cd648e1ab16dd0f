"""The unknown strength of lights (Sec. 5.1): one colour for each light, or for its picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from .arrays import from_numpy

BOUND = 20.0  #: of the log of strength over that at the start, so that nothing overflows


class Pattern(Protocol):
    """How a lamp differs over its surface; `scene.emitters.Picture` is one."""

    @property
    def texture(self) -> mi.Texture:
        """What it looks into."""

    @property
    def sampled_by_it(self) -> bool:
        """Whether the lamp is sampled by texture coordinates."""
        ...

    def relative(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Color3f:
        """Factors of the strength at points, linear RGB; their mean is 1."""

    def sampled(self) -> np.ndarray:
        """The same as a picture, float32, shape (rows, columns, 3)."""
        ...


class Emission:
    """One linear RGB strength for each light, positive by construction: scale · exp(φ).

    After `assign`, and after a frozen function that assigns, call `prepare`.

    Args:
        count: number of lights.
        scale: strength at the start, unless `start` says another: radiance in W·sr⁻¹·m⁻² for area
            lights and constant environments, intensity in W·sr⁻¹ for point and spot lights,
            irradiance in W·m⁻² for directional ones.
        patterns: how lights differ over their surface, of each light; None: it has one colour, as
            all have without any. The strength is the mean of what differs.

    Paper: Sec. 5.1.
    """

    def __init__(
        self, count: int, *, scale: float, patterns: Sequence[Pattern | None] = ()
    ) -> None:
        self.count = count
        self.patterns = list(patterns) or [None] * count
        self.scale = scale
        self._lastly: np.ndarray | None = None  # what is held after `release`
        self._log = dr.zeros(mi.Float, 3 * count)
        dr.make_opaque(self._log)
        #: The logs at the start, which of them are held, and what `prepare` computes; textures
        #: hold it too.
        self.tables = {
            "start": dr.zeros(mi.Color3f, count),
            "held": dr.zeros(mi.Color3f, count),
        }
        dr.make_opaque(self.tables)
        self.prepare()

    def start(self, factors: Sequence[float] | np.ndarray) -> None:
        """Begin with other strengths than the scale.

        Args:
            factors: of each light, on the scale, or of each of its channels, shape (lights, 3).
        """
        if len(factors) != self.count:
            raise ValueError(f"{len(factors)} factors for {self.count} lights")
        each = np.broadcast_to(np.reshape(factors, (self.count, -1)), (self.count, 3))
        logs = np.log(each).ravel().astype(np.float32)
        self._log = from_numpy(mi.Float, logs)
        self.tables["start"] = dr.unravel(mi.Color3f, from_numpy(mi.Float, logs))
        dr.make_opaque(self.tables)
        self.prepare()

    def hold(self, which: np.ndarray, *, lastly: np.ndarray | None = None) -> None:
        """Let no gradient reach some strengths, which then stay as they are.

        Args:
            which: of the lights, shape (lights, 3) bool.
            lastly: those that are held after `release`, too; None: none are.
        """
        self._lastly = np.zeros_like(which) if lastly is None else lastly
        held = from_numpy(mi.Float, which.astype(np.float32).ravel())
        self.tables["held"] = dr.unravel(mi.Color3f, held)
        dr.make_opaque(self.tables)

    def release(self) -> None:
        """Let gradients reach what `hold` held, but for what is held to the last."""
        if self._lastly is not None:
            self.hold(self._lastly)
            self._lastly = None

    @property
    def held(self) -> list[int]:
        """The lights of which no gradient reaches some channel."""
        held = np.array(self.tables["held"]).reshape(3, -1)
        return np.flatnonzero(held.any(0)).tolist()

    def parameters(self) -> dict[str, mi.Float]:
        """The trainable array, RGB of one light after the other; `assign` takes it back."""
        return {"log": self._log}

    def assign(self, parameters: dict[str, mi.Float]) -> None:
        """Use this array from the next `prepare` on; gradients arrive in the array given."""
        self._log = parameters["log"]

    def prepare(self) -> None:
        """Compute `values`; to be called outside of virtual calls and loops."""
        log = dr.unravel(mi.Color3f, self._log)
        moved = log - self.tables["start"]
        # Clipped entries keep a gradient, which brings them back.
        log += dr.detach(dr.clip(moved, -BOUND, BOUND) - moved)
        log = dr.select(self.tables["held"] > 0, dr.detach(log), log)
        self.tables["values"] = self.scale * dr.exp(log)
        dr.eval(self.tables)

    @property
    def values(self) -> mi.Color3f:
        """Linear RGB, one lane a light; passes gradients to the parameters."""
        return self.tables["values"]


def emission_textures(emission: Emission) -> list[mi.Texture]:
    """A texture for each light, to stand where its strength is given.

    Paper: Sec. 5.1.
    """

    # The class is made here because `mi.Texture` exists only once a variant has been chosen.
    class Strength(mi.Texture):
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.number = props["number"]
            # A frozen function calls all textures that there are, those of other scenes too. What
            # they read it finds in their attributes alone.
            self.tables = emission.tables
            self.pattern: Pattern | None = None
            self.texture: mi.Texture | None = None

        def eval(self, si, active=True):
            found = dr.gather(mi.Color3f, emission.values, mi.UInt32(self.number), active)
            return found if self.pattern is None else found * self.pattern.relative(si, active)

        def eval_1(self, si, active=True):
            return mi.luminance(self.eval(si, active))

        def eval_3(self, si, active=True):
            return self.eval(si, active)

        def mean(self):
            return mi.luminance(dr.gather(mi.Color3f, emission.values, mi.UInt32(self.number)))

        def is_spatially_varying(self):
            # A mesh would be looked up in a scene of its own, of which no frozen function knows.
            return self.pattern is not None and self.pattern.sampled_by_it

        def to_string(self):
            return f"Strength[{self.number}]"

    textures = []
    for number, pattern in enumerate(emission.patterns):
        props = mi.Properties()
        props["number"] = number
        texture = Strength(props)
        if pattern is not None:
            # By this attribute a frozen function knows of its arrays
            texture.pattern, texture.texture = pattern, pattern.texture
        textures.append(texture)
    return textures
