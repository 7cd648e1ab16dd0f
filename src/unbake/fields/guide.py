"""Path guiding: where light comes from at each place, learned together with L_θ (ours)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from .arrays import read_small, sigmoid
from .domain import Domain
from .settings import GuideConfig

#: Share of each distribution that is uniform over the sphere: no direction is left out.
_UNIFORM = 0.1
#: The largest share of bounces whose direction is drawn by the guide.
_MOST = 0.9
#: Logarithms of densities, and of the odds of a guided bounce, are these multiples of what Adam
#: moves, so that they learn at the rate of L_θ.
_GAIN, _GAIN_OF_SHARES = 10.0, 4.0
#: Largest magnitude of a log density, so that its exponential stays finite.
_FURTHEST = 40.0
#: Upper bound on a sample's weight, in multiples of the pixel's radiance, against fireflies.
_MOST_WEIGHT = 20.0


@dataclass
class Choice:
    """What a guide learns from the direction of a bounce; a PyTree."""

    cell: mi.UInt32
    direction: mi.Vector3f  # that was drawn, world space
    pdf: mi.Float  # of the BSDF in that direction, solid angle


@dataclass(frozen=True)
class Mixture:
    """A guide and a BSDF, by one of which each direction is drawn."""

    guide: LightGuide
    cell: mi.UInt32
    share: mi.Float  # probability that the guide draws

    def decide(self, number: mi.Float) -> tuple[mi.Bool, mi.Float]:
        """Whether the guide draws, by a uniform random number, and one for the BSDF to draw by."""
        guided, rest = number < self.share, number - self.share
        last = dr.one_minus_epsilon(mi.Float)
        return guided, dr.select(guided, 0, dr.minimum(rest / (1 - self.share), last))

    def pdf(self, pdf: mi.Float, direction: mi.Vector3f) -> mi.Float:
        """The density of a direction, drawn by either, where the BSDF's is `pdf`."""
        return dr.fma(self.share, self.guide.pdf(self.cell, direction) - pdf, pdf)


class LightGuide:
    """Distributions of directions, by which bounces find the light that surfaces reflect.

    Directions drawn by the BSDF alone seldom meet small bright places, and nearly all noise of one
    bounce is that of the radiance that it meets. Here the cells of a grid over a cube of the scene,
    each divided by the six directions that normals are nearest to, have a distribution over world
    space directions, constant in bins of equal solid angle: bands of height z times sectors around
    the z axis. It is learned by the cross-entropy with what samples contribute, and so is the share
    of bounces that are drawn by it. It changes the noise of estimates, and not what they expect.

    Args:
        settings: sizes.
        domain: the cube, of the scene or of what cameras see of it; what lies outside has the cells
            at its faces.

    See Müller et al. 2017, Practical Path Guiding, and Müller 2019, whose shares are learned alike.
    """

    def __init__(self, settings: GuideConfig, domain: Domain) -> None:
        self._settings = settings
        self._domain = domain
        cells = 6 * settings.cells**3
        self._bins = settings.bands * settings.sectors
        self._logits = dr.opaque(mi.Float, 0, cells * self._bins)
        self._odds = dr.opaque(mi.Float, 0, cells)

    def parameters(self) -> dict[str, mi.Float]:
        """`guide.directions` and `guide.shares`, which are learned beside θ."""
        return {"guide.directions": self._logits, "guide.shares": self._odds}

    def assign(self, parameters: Mapping[str, Any]) -> None:
        """Use these arrays from now on; densities and samples need `prepare` first."""
        self._logits, self._odds = parameters["guide.directions"], parameters["guide.shares"]

    def prepare(self) -> None:
        """Make the tables that directions are drawn from."""
        with dr.suspend_grad():
            self._weights = dr.exp(dr.clip(_GAIN * self._logits, -_FURTHEST, _FURTHEST))
            self._sums = dr.block_prefix_sum(self._weights, self._bins, exclusive=False)
            dr.eval(self._weights, self._sums)

    def cell(self, p: mi.Point3f, n: mi.Normal3f, valid: mi.Bool) -> mi.UInt32:
        """The cell of points in world space with their unit normals."""
        count = self._settings.cells
        at = [dr.minimum(mi.UInt32(x * count), count - 1) for x in self._domain.to_unit(p, valid)]
        size = dr.abs(n)
        first, second = (size.x >= size.y) & (size.x >= size.z), size.y >= size.z
        axis = dr.select(first, mi.UInt32(0), dr.select(second, mi.UInt32(1), mi.UInt32(2)))
        along = dr.select(first, n.x, dr.select(second, n.y, n.z))
        side = 2 * axis + dr.select(along > 0, mi.UInt32(1), mi.UInt32(0))
        return dr.select(valid, ((at[0] * count + at[1]) * count + at[2]) * 6 + side, 0)

    def mixture(self, cell: mi.UInt32, dense: mi.Bool) -> Mixture:
        """The guide and a BSDF at vertices; detached.

        Args:
            cell: of the vertices.
            dense: whether all directions of the BSDF have a density; elsewhere it alone draws.
        """
        with dr.suspend_grad():
            return Mixture(self, cell, dr.select(dense, self.share(cell), 0))

    def share(self, cell: mi.UInt32) -> mi.Float:
        """The probability that the guide draws a bounce from a cell."""
        return _MOST * sigmoid(_GAIN_OF_SHARES * read_small(self._odds, cell))

    def pdf(self, cell: mi.UInt32, direction: mi.Vector3f) -> mi.Float:
        """The density of unit directions in world space, solid angle; as was prepared."""
        weight = dr.gather(mi.Float, self._weights, cell * self._bins + self._bin(direction))
        part = dr.fma(1 - _UNIFORM, weight / self._total(cell), _UNIFORM / self._bins)
        return part * (self._bins / (4 * math.pi))

    def sample(self, cell: mi.UInt32, number: mi.Point2f) -> mi.Vector3f:
        """Unit directions in world space from uniform random numbers, [0,1)²; as was prepared."""
        s, first, scale = self._settings, cell * self._bins, (1 - _UNIFORM) / self._total(cell)

        def below(bins: mi.UInt32, weights: mi.Float) -> mi.Float:
            """The probability of the first bins, whose weights sum to this."""
            return dr.fma(scale, weights, mi.Float(bins) * (_UNIFORM / self._bins))

        chosen = dr.binary_search(
            0,
            self._bins - 1,
            lambda i: below(i + 1, dr.gather(mi.Float, self._sums, first + i)) < number.x,
        )
        weight = dr.gather(mi.Float, self._weights, first + chosen)
        start = below(chosen, dr.gather(mi.Float, self._sums, first + chosen) - weight)
        rest = dr.clip((number.x - start) / below(mi.UInt32(1), weight), 0, 1)
        band, sector = chosen // s.sectors, chosen % s.sectors
        z = 2 * (mi.Float(band) + rest) / s.bands - 1
        sine, cosine = dr.sincos(2 * dr.pi * (mi.Float(sector) + number.y) / s.sectors)
        radius = dr.safe_sqrt(1 - dr.square(z))
        return mi.Vector3f(radius * cosine, radius * sine, z)

    def loss(self, choice: Choice, weight: mi.Float) -> mi.Float:
        """The cross-entropy of the distributions with what samples contribute; smaller is better.

        The guide's own density trains the directions, so that one that found nothing so far
        recovers once there is light; the density of the mixture trains the shares.

        Args:
            choice: of each sample.
            weight: its contribution to its pixel, over the pixel's radiance.
        """
        n, cell = self._bins, choice.cell
        weight = dr.select(weight > 0, dr.detach(dr.minimum(weight, _MOST_WEIGHT)), 0)
        mixed = Mixture(self, cell, self.share(cell)).pdf(choice.pdf, choice.direction)
        index, count = cell * n + self._bin(choice.direction), dr.width(weight)
        own = dr.log(dr.gather(mi.Float, self._weights, index) / self._total(cell))
        told = -dr.mean(dr.select(weight > 0, weight * (own + dr.log(mixed)), 0))
        # `_weights` is detached, so `told` trains the shares alone. The gradient of `own` by the
        # logits is that of a softmax, whose normalizer reaches all bins of a cell. Written out, it
        # takes one sum per cell, not a scatter per sample and bin. `slope` has that gradient; its
        # value is not used.
        logits = _GAIN * self._logits
        here = dr.gather(mi.Float, logits, index, mode=dr.ReduceMode.Direct)
        found = dr.zeros(mi.Float, dr.width(self._odds))
        dr.scatter_add(found, weight, cell, mode=dr.ReduceMode.Local)  # as in `read_small`
        every = self._weights * dr.repeat(found / self._total(dr.arange(mi.UInt32, len(found))), n)
        slope = dr.sum(every * logits) / count - dr.mean(weight * here)
        return told + dr.replace_grad(mi.Float(0), slope)

    def _total(self, cell: mi.UInt32) -> mi.Float:
        """The sum of a cell's weights."""
        return dr.gather(mi.Float, self._sums, cell * self._bins + (self._bins - 1))

    def _bin(self, direction: mi.Vector3f) -> mi.UInt32:
        s, d = self._settings, dr.detach(direction)
        band = dr.clip(mi.Int32(0.5 * (d.z + 1) * s.bands), 0, s.bands - 1)
        turn = dr.atan2(d.y, d.x) / (2 * dr.pi)
        sector = dr.clip(mi.Int32((turn - dr.floor(turn)) * s.sectors), 0, s.sectors - 1)
        return mi.UInt32(band * s.sectors + sector)
