"""The unknown environment map: radiance as a function of world direction (Sec. 5.1, Fig. 8).

Directions are mapped to the unit square by the equal-area octahedral map (Clarberg 2008): all
texels have one solid angle and the poles are like any other place. The upper hemisphere (+z) is the
square's inner diamond; the -z pole is in all four corners.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np

from .domain import bounded

COARSEST = 4  #: texels along an edge of the first level
COARSE = 8  #: texels along an edge of the last level that is coarse
UNIFORM_SHARE = 0.05  #: of the directions, drawn from the whole sphere, so that no density is zero
BOUND = 20.0  #: of the log of radiance over scale, so that nothing overflows single precision
FAR = 1e10  #: distance of the environment, in world units; it only has to lie behind all shapes


class EnvironmentMap:
    """Learned radiance of an environment, positive by construction.

    L = scale · exp(Σ gain · level), bilinear in the square. The levels have 4², 8², … resolution²
    texels, each interpolated to the next: coarse ones let low frequencies converge fast.

    After `assign`, and after a frozen function that assigns, call `prepare`.

    Args:
        resolution: texels along an edge of the square, a power of two, 4 or more.
        scale: radiance at the start, linear RGB, W·sr⁻¹·m⁻².
        coarse_gain: gain of coarse levels, which Adam moves so many times as fast; 1 of all others.

    Paper: Sec. 5.1, Fig. 8.
    """

    def __init__(self, resolution: int, *, scale: float, coarse_gain: float = 1.0) -> None:
        self.resolution = resolution
        self.scale = scale
        self.coarse_gain = coarse_gain
        sizes = [COARSEST]
        while sizes[-1] < resolution:
            sizes.append(2 * sizes[-1])
        #: By edge length: RGB of each texel, row by row.
        self._levels = {n: dr.zeros(mi.Float, 3 * n * n) for n in sizes}
        dr.make_opaque(self._levels)
        #: What `prepare` computes; emitters hold it too.
        self.tables: dict[str, mi.Float] = {}
        self.prepare()

    def parameters(self) -> dict[str, mi.Float]:
        """The trainable arrays by name; `assign` takes them back."""
        return {f"level.{n}": level for n, level in self._levels.items()}

    def assign(self, parameters: dict[str, mi.Float]) -> None:
        """Use these arrays from the next `prepare` on; gradients arrive in the arrays given."""
        self._levels = {n: parameters[f"level.{n}"] for n in self._levels}

    def prepare(self) -> None:
        """Compute texels, which pass gradients to the parameters, and tables for sampling.

        To be called outside of virtual calls and loops. It reads nothing back from the device.
        """
        size = self.resolution
        latent = mi.Color3f(0)
        for n, level in self._levels.items():
            coarse = _upsampled(latent, n // 2) if n > COARSEST else 0
            gain = self.coarse_gain if n <= COARSE else 1.0
            latent = gain * dr.unravel(mi.Color3f, level) + coarse
        # Clipped texels keep a gradient, which brings them back.
        latent += dr.detach(dr.clip(latent, -BOUND, BOUND) - latent)
        values = self.scale * dr.exp(latent)

        # With a frame of one texel around the square, lookups need not care about its edges.
        lane = dr.arange(mi.Int32, (size + 2) ** 2)
        frame = _wrapped(lane % (size + 2) - 1, lane // (size + 2) - 1, size)
        framed = dr.gather(mi.Color3f, values, frame)
        # A fourth number makes texels single packets of memory.
        self.tables["texels"] = dr.ravel(mi.Vector4f(*framed, 0))
        dr.eval(self.tables)
        with dr.suspend_grad():
            self._prepare_sampling(values)

    def _prepare_sampling(self, values: mi.Color3f) -> None:
        size = self.resolution
        brightness = mi.luminance(values)
        dr.eval(brightness)
        # The mean over a texel's area of what is interpolated between texels: a tent filter.
        lane = dr.arange(mi.Int32, size * size)
        mean = mi.Float(0)
        for y, x in np.ndindex(3, 3):
            near = _wrapped(lane % size + (x - 1), lane // size + (y - 1), size)
            share = (6 if x == 1 else 1) * (6 if y == 1 else 1) / 64
            mean += share * dr.gather(mi.Float, brightness, near)
        dr.eval(mean)
        mean *= dr.rcp(dr.sum(mean))
        dr.eval(mean)
        self.tables["probability"] = mean
        self.tables["columns"] = dr.block_prefix_sum(mean, size, exclusive=False)
        self.tables["rows"] = dr.cumsum(dr.block_sum(mean, size))
        dr.eval(self.tables)

    @property
    def texels(self) -> mi.Float:
        """The texels that lookups read; they pass gradients to the parameters."""
        return self.tables["texels"]

    def radiance(self, d: mi.Vector3f, active: mi.Bool = True) -> mi.Color3f:
        """Radiance that arrives from unit world directions `d`, linear RGB.

        Gradients go to the parameters, not to `d`. Lanes that are not active get zero.
        """
        active, stride = mi.Bool(active), self.resolution + 2
        # Directions that are no numbers look up a corner: as indices they would be out of bounds.
        p = bounded(to_square(dr.detach(d)) * self.resolution + 0.5, 0, self.resolution + 1)
        cell = mi.Point2u(dr.minimum(p, self.resolution))
        f = p - mi.Point2f(cell)
        first = cell.y * stride + cell.x
        texel = [
            dr.gather(mi.Vector4f, self.texels, first + offset, active)
            for offset in (0, 1, stride, stride + 1)
        ]
        value = dr.lerp(dr.lerp(texel[0], texel[1], f.x), dr.lerp(texel[2], texel[3], f.x), f.y)
        return dr.select(active, mi.Color3f(value.x, value.y, value.z), 0)

    def sample(self, sample: mi.Point2f, active: mi.Bool = True) -> tuple[mi.Vector3f, mi.Float]:
        """Draw directions by brightness, with a small uniform share; no gradients.

        Args:
            sample: uniform random numbers in [0,1)².

        Returns:
            Unit world directions and their densities in solid angle.
        """
        with dr.suspend_grad():
            uniform = sample.x < UNIFORM_SHARE
            rest = (sample.x - UNIFORM_SHARE) / (1 - UNIFORM_SHARE)
            size, rows, columns = self.resolution, self.tables["rows"], self.tables["columns"]
            row, y = _inverted(rows, mi.UInt32(0), size, sample.y, active)
            column, x = _inverted(columns, row * size, size, rest, active)
            p = mi.Point2f((column + x) / size, (row + y) / size)
            p = dr.select(uniform, mi.Point2f(sample.x / UNIFORM_SHARE, sample.y), p)
            return from_square(p), self._density(p, active)

    def pdf(self, d: mi.Vector3f, active: mi.Bool = True) -> mi.Float:
        """Density of `sample` in solid angle at unit world directions `d`; no gradients."""
        return self._density(to_square(dr.detach(d)), active)

    def _density(self, p: mi.Point2f, active: mi.Bool) -> mi.Float:
        cell = mi.Point2u(bounded(p * self.resolution, 0, self.resolution - 1))
        texel = cell.y * self.resolution + cell.x
        chosen = dr.gather(mi.Float, self.tables["probability"], texel, active)
        return dr.lerp(chosen * self.resolution**2, 1, UNIFORM_SHARE) / (4 * math.pi)

    def to_latlong(self, height: int) -> np.ndarray:
        """The map as a picture that Mitsuba's `envmap` loads (identity `to_world`).

        Returns:
            Linear RGB radiance, float32, shape (height, 2 height, 3). Heights from twice the
            resolution on keep all detail.
        """
        return latlong(self.radiance, height, max(1, 2 * self.resolution // height))


def environment_emitter(environment: EnvironmentMap) -> mi.Emitter:
    """The map as a Mitsuba emitter, so that stock integrators run on it.

    It can be evaluated and sampled from surfaces; rays cannot be started on it (as in light
    tracing).

    Paper: Sec. 5.1.
    """

    # The class is made here because `mi.Emitter` exists only once a variant has been chosen.
    class LearnedEnvironment(mi.Emitter):
        def __init__(self, props: mi.Properties) -> None:
            super().__init__(props)
            self.m_flags = mi.EmitterFlags.Infinite | mi.EmitterFlags.SpatiallyVarying
            # A frozen function calls all emitters that there are, those of other scenes too. What
            # they read it finds in their attributes alone.
            self.tables = environment.tables

        def eval(self, si, active=True):
            return environment.radiance(-si.wi, active)

        def sample_direction(self, it, sample, active=True):
            d, pdf = environment.sample(sample, active)
            ds = dr.zeros(mi.DirectionSample3f)
            ds.p, ds.n, ds.d, ds.dist = dr.fma(d, FAR, dr.detach(it.p)), -d, d, mi.Float(FAR)
            ds.pdf, ds.time = pdf, it.time
            ds.emitter = mi.EmitterPtr(self)
            return ds, environment.radiance(d, active) / pdf

        def pdf_direction(self, it, ds, active=True):
            return environment.pdf(ds.d, active)

        def eval_direction(self, it, ds, active=True):
            return environment.radiance(ds.d, active)

        def bbox(self):
            return mi.ScalarBoundingBox3f()

        def to_string(self):
            return f"LearnedEnvironment[{environment.resolution}]"

    return LearnedEnvironment(mi.Properties())


def latlong(radiance: Callable[[mi.Vector3f], mi.Color3f], height: int, samples: int) -> np.ndarray:
    """Radiance over directions in the layout of Mitsuba's `envmap` with identity `to_world`.

    +y is up; the first and the last row are the poles, and -z is at the border of the first column.

    Args:
        radiance: of unit world directions, linear RGB.
        height: rows, 2 or more.
        samples: averaged along each edge of a pixel.

    Returns:
        float32, shape (height, 2 height, 3).
    """
    picture = np.zeros((height * 2 * height, 3))
    lane = dr.arange(mi.UInt32, height * 2 * height)
    x, y = mi.Float(lane % (2 * height)), mi.Float(lane // (2 * height))
    with dr.suspend_grad():
        for i, j in np.ndindex(samples, samples):
            # The offset inside the pixel comes as an array, so that one kernel serves all.
            dx, dy = (dr.opaque(mi.Float, (k + 0.5) / samples - 0.5) for k in (i, j))
            φ = (x + 0.5 + dx) * (math.pi / height)
            θ = dr.clip((y + dy) * (math.pi / (height - 1)), 0, math.pi)
            (sin_φ, cos_φ), (sin_θ, cos_θ) = dr.sincos(φ), dr.sincos(θ)
            value = radiance(mi.Vector3f(sin_φ * sin_θ, cos_θ, -cos_φ * sin_θ))
            picture += np.array(value).T
    return (picture / samples**2).astype(np.float32).reshape(height, 2 * height, 3)


def solid_angles(rows: int) -> np.ndarray:
    """Those of pixels of `latlong`, (rows, 2 rows); the first and the last row are the poles."""
    edges = np.cos(np.pi * np.clip((np.arange(rows + 1) - 0.5) / (rows - 1), 0, 1))
    return np.repeat((edges[:-1] - edges[1:])[:, None] * np.pi / rows, 2 * rows, 1)


# --------------------------------------------------------------------------------- the square


def to_square(d: mi.Vector3f) -> mi.Point2f:
    """Unit directions to [0,1]², equal areas to equal areas (Clarberg 2008)."""
    a, b = dr.abs(d.x), dr.abs(d.y)
    # √(1 - |z|), without the cancellation near the poles.
    r = dr.sqrt((d.x * d.x + d.y * d.y) / (1 + dr.abs(d.z)))
    v = r * dr.atan2(b, dr.maximum(a, 1e-30)) * (2 / math.pi)
    u = r - v
    below = d.z < 0
    u, v = dr.select(below, 1 - v, u), dr.select(below, 1 - u, v)
    return mi.Point2f(0.5 + 0.5 * dr.copysign(u, d.x), 0.5 + 0.5 * dr.copysign(v, d.y))


def from_square(p: mi.Point2f) -> mi.Vector3f:
    """The inverse of `to_square`."""
    u, v = 2 * p.x - 1, 2 * p.y - 1
    a, b = dr.abs(u), dr.abs(v)
    inside = 1 - (a + b)  # negative below the equator
    r = 1 - dr.abs(inside)
    φ = dr.select(r > 0, (b - a) / dr.maximum(r, 1e-30) + 1, 1) * (math.pi / 4)
    sin_φ, cos_φ = dr.sincos(φ)
    s = r * dr.safe_sqrt(2 - r * r)
    z = dr.copysign(1 - r * r, inside)
    return mi.Vector3f(s * dr.copysign(cos_φ, u), s * dr.copysign(sin_φ, v), z)


def _wrapped(x: mi.Int32, y: mi.Int32, n: int) -> mi.UInt32:
    """The texel at column x and row y, at most one outside an n x n square: edges are mirrored."""
    beside, above = (x < 0) | (x >= n), (y < 0) | (y >= n)
    column = dr.clip(dr.select(above, n - 1 - x, x), 0, n - 1)
    row = dr.clip(dr.select(beside, n - 1 - y, y), 0, n - 1)
    return mi.UInt32(row * n + column)


def _upsampled(image: mi.Color3f, n: int) -> mi.Color3f:
    """An n x n image at twice the resolution, bilinearly."""
    dr.eval(image)
    lane = dr.arange(mi.Int32, 4 * n * n)
    x, y = lane % (2 * n), lane // (2 * n)
    # Texels lie a quarter of a coarse one beside the nearest of those.
    near_x, near_y = x // 2, y // 2
    far_x, far_y = near_x + 2 * (x & 1) - 1, near_y + 2 * (y & 1) - 1
    taps = [(near_x, near_y, 9), (far_x, near_y, 3), (near_x, far_y, 3), (far_x, far_y, 1)]
    return sum(w / 16 * dr.gather(mi.Color3f, image, _wrapped(i, j, n)) for i, j, w in taps)


def _inverted(
    sums: mi.Float, first: mi.UInt32, n: int, sample: mi.Float, active: mi.Bool
) -> tuple[mi.UInt32, mi.Float]:
    """Choose one of n entries of a running sum that begins at `first`.

    Returns:
        Its number, and what is left of the random number, in [0,1).
    """
    target = sample * dr.gather(mi.Float, sums, first + (n - 1), active)
    index = dr.binary_search(
        0, n - 1, lambda i: dr.gather(mi.Float, sums, first + i, active) <= target
    )
    index = mi.UInt32(index)
    before = dr.gather(mi.Float, sums, first + index - 1, mi.Bool(active) & (index > 0))
    chosen = dr.gather(mi.Float, sums, first + index, active) - before
    rest = (target - before) / dr.maximum(chosen, 1e-30)
    return index, bounded(rest, 0, 1 - 2**-24)
