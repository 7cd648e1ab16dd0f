"""What is unknown of the cameras that took the photographs (ours).

A photograph P shows radiance L through a camera, channel by channel:

    f(P) = e · w · v(r) · L

with e the exposure of the image, w its white balance, v(r) the vignetting at the radius r of the
pixel, and f the inverse of the camera's response. The gain e · w · v is applied to renderings and f
to photographs: a loss is then linear in what is noisy, the rendering, and its gradients stay
unbiased.

Photographs alone leave some of it open, which conventions decide:

- All exposures times a number is all radiance divided by it. The exposure of the first training
  view is as the data set tells, and so is its white balance where each image has one of its own.
  Steps move slowly what the others have in common, which this view alone tells them.
- A white balance that all images share is told from the colour of albedo by interreflection, and
  by lights that are seen, alone, and only where lights are known: else it is their colour.
- v is 1 at the centre, and f(0) = 0. f(P) = P at the middle of the code values of an 8-bit file,
  which is where cameras put a surface of 18 % (ISO 12232: code 118 of 255). Photographs have most
  of their pixels around there; where white is, 1, few of them say anything.
- f is told by photographs of the same points with exposures that differ, and by next to nothing
  else: with one exposure any f explains the photographs, each with another albedo. It is found
  before the first step, and stays (`first_response.py`).
- A power of f, of all exposures and of all radiance explains the same differences between
  photographs. What lights and geometry say of radiance decides the exponent; where they say
  little, the smoothness of f does, and that white stays close to white (`first_response.py`).
- Where each image has a white balance of its own, that holds for red and blue by themselves, even
  if exposures are told: what decides then is that f is alike in all channels.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, Literal, final

import drjit as dr
import mitsuba as mi
import numpy as np

from .arrays import from_numpy, read_small

#: Which images share a white balance.
Balance = Literal["known", "common", "per-image"]

#: Of the log of exposures and white balances, so that nothing overflows single precision.
BOUND = 20.0
#: Weights of the terms of vignetting: steps of the optimizer move the lower orders more, as lenses
#: have more of them.
_ORDERS = (1.0, 1 / 4, 1 / 16)
#: The least that vignetting leaves of the light.
_DARKEST = 0.05
#: Pieces of f, of equal length where photographs are as an 8-bit file has them.
PIECES, GAMMA = 16, 2.2
#: Of a step that all images take together, away from the anchor, the part that is kept.
_COMMON = 0.1
#: `softplus` of it is 1.
_UNIT = math.log(math.e - 1)


@final
class CameraModel:
    """The unknown exposures, white balance, vignetting and response of training views.

    Before it is begun or trained all is as the data set tells: every gain is 1, and f(P) = P.

    Args:
        views: number of training views.
        exposure: whether each image has an exposure of its own.
        white_balance: of red and blue relative to green.
        vignetting: whether there is one, 1 + a r² + b r⁴ + c r⁶ for all images.
        response: whether the response is unknown, a curve for each channel.
    """

    def __init__(
        self,
        views: int,
        *,
        exposure: bool = False,
        white_balance: Balance = "known",
        vignetting: bool = False,
        response: bool = False,
    ) -> None:
        self.views = views
        self.white_balance = white_balance
        sizes = {
            "exposure.log": views * exposure,
            "white_balance.log": 2 * {"known": 0, "common": 1, "per-image": views}[white_balance],
            "vignetting.terms": 3 * vignetting,
            "response.log": 3 * PIECES * response,
        }
        self._arrays = {key: dr.zeros(mi.Float, size) for key, size in sizes.items() if size}
        dr.make_opaque(self._arrays)

    @property
    def has_response(self) -> bool:
        """Whether the response is unknown."""
        return "response.log" in self._arrays

    @property
    def has_exposures(self) -> bool:
        """Whether each image has an unknown exposure."""
        return "exposure.log" in self._arrays

    def parameters(self) -> dict[str, mi.Float]:
        """The trainable arrays; `assign` takes them back."""
        return dict(self._arrays)

    def assign(self, parameters: Mapping[str, Any]) -> None:
        """Use these arrays from now on; gradients arrive in the arrays given."""
        self._arrays = {key: parameters[key] for key in self._arrays}

    def start(self, gains: np.ndarray) -> None:
        """Begin with other gains than 1, as far as these are unknown.

        Args:
            gains: linear RGB of each view, shape (views, 3).
        """
        logs = np.log(gains)
        if "exposure.log" in self._arrays:
            found = logs[:, 1] if self.white_balance == "per-image" else logs.mean(1)
            self._arrays["exposure.log"] = from_numpy(mi.Float, found.astype(np.float32))
        if self.white_balance == "per-image":
            found = logs[:, [0, 2]] - logs[:, [1]]
            self._arrays["white_balance.log"] = from_numpy(mi.Float, found.astype(np.float32))

    def start_vignetting(self, falloff: Callable[[np.ndarray], np.ndarray]) -> None:
        """Begin with another vignetting than none.

        Args:
            falloff: v of squared radii.
        """
        radius2 = np.linspace(0, 1, 65)
        powers = np.stack([radius2, radius2**2, radius2**3], 1)
        terms = np.linalg.lstsq(powers, falloff(radius2) - 1, rcond=None)[0] / _ORDERS
        self._arrays["vignetting.terms"] = from_numpy(mi.Float, terms.astype(np.float32))

    def start_response(self, curves: np.ndarray) -> None:
        """Begin with another response than f(P) = P.

        Args:
            curves: as `curves` gives them.
        """
        slopes = PIECES * np.diff(curves)
        logs = np.log(np.expm1(slopes)) - _UNIT
        self._arrays["response.log"] = from_numpy(mi.Float, logs.astype(np.float32).ravel())

    # ---------------------------------------------------------------------------- in a step

    def gain(self, view: mi.UInt32, radius2: mi.Float) -> mi.Color3f:
        """The gains e · w · v of pixels, by which their renderings are multiplied.

        Args:
            view: of each pixel.
            radius2: squared distance of each pixel from the principal point; 1 is that of a corner.
        """
        lanes = dr.width(view)
        gain = mi.Color3f(dr.ones(mi.Float, lanes))
        if "exposure.log" in self._arrays:
            gain *= _exp(self._relative("exposure.log", view, 0, 1))
        if self.white_balance == "common":
            array = self._arrays["white_balance.log"]
            red, blue = (read_small(array, dr.full(mi.UInt32, i, lanes)) for i in range(2))
            gain *= mi.Color3f(_exp(red), 1, _exp(blue))
        elif self.white_balance == "per-image":
            red, blue = (self._relative("white_balance.log", view, i, 2) for i in range(2))
            gain *= mi.Color3f(_exp(red), 1, _exp(blue))
        if "vignetting.terms" in self._arrays:
            array = self._arrays["vignetting.terms"]
            a, b, c = (
                order * read_small(array, dr.full(mi.UInt32, i, lanes))
                for i, order in enumerate(_ORDERS)
            )
            falloff = dr.fma(radius2, dr.fma(radius2, dr.fma(radius2, c, b), a), 1)
            gain *= dr.maximum(falloff, _DARKEST)
        return gain

    def slowed(self, before: Mapping[str, Any], after: Mapping[str, Any]) -> dict[str, mi.Float]:
        """Parameters whose steps are slower where all images take them together.

        Steps learn what the others have in common from one photograph alone, the anchor. Meanwhile
        what the scene lacks there, and albedo that is not there yet, move all of them. Photographs
        of the same points, with which exposures begin, tell more of it.

        Args:
            before, after: the parameters before and after a step; others are ignored.

        Returns:
            Those that change.
        """
        strides = {"exposure.log": 1}
        if self.white_balance == "per-image":
            strides["white_balance.log"] = 2
        found, others = {}, self.views - 1
        for key, stride in strides.items():
            if key not in self._arrays or not others:
                continue
            old, new = dr.detach(before[key]), dr.detach(after[key])
            moved, place = new - old, dr.arange(mi.UInt32, self.views * stride)
            kept = mi.Float(new)
            for offset in range(stride):
                own = place % stride == offset
                of_anchor = dr.gather(mi.Float, moved, mi.UInt32(offset))
                together = dr.sum(dr.select(own, moved - of_anchor, 0)) / others
                others_own = own & (place >= stride)
                kept -= dr.select(others_own, (1 - _COMMON) * together, 0)
            found[key] = kept
        return found

    def exposed(self, photograph: mi.Color3f) -> mi.Color3f:
        """Photographs through f, linear RGB; the same where the response is known.

        Gradients arrive in photographs. f gets none: in steps noise of photographs and what is
        still wrong of materials would move it.
        """
        if not self.has_response:
            return photograph
        heights = dr.detach(self._heights())
        return mi.Color3f([self._inverse(photograph[i], heights, i) for i in range(3)])

    def _relative(self, key: str, view: mi.UInt32, offset: int, stride: int) -> mi.Float:
        """Entries of views less that of the first view, which is the anchor."""
        array = self._arrays[key]
        anchor = read_small(array, dr.full(mi.UInt32, offset, dr.width(view)))
        return read_small(array, stride * view + offset) - anchor

    def _heights(self) -> mi.Float:
        """The curve f at `PIECES` + 1 places of each channel, as `curves`."""
        row, column = PIECES + 1, PIECES
        lane = dr.arange(mi.UInt32, 3 * row * column)
        place, piece = lane // column, lane % column
        channel = place // row
        logs = self._arrays["response.log"]
        slopes = _softplus(read_small(logs, channel * PIECES + piece) + _UNIT)
        risen = dr.block_sum(dr.select(piece < place % row, slopes, 0), column)
        # The middle stays where it is: see above.
        half = dr.block_sum(dr.select(piece < PIECES // 2, slopes, 0), column)
        heights = 0.5 * risen / half
        dr.eval(heights)
        return heights

    def _inverse(self, value: mi.Float, heights: mi.Float, channel: int) -> mi.Float:
        """One channel through f: pieces of positive slope, equal ones for 8-bit files.

        No file has values below zero, but noise has, once it is corrected. As u^2.2, the first
        piece is straight, and goes on there: noise about black keeps its mean.
        """
        place = dr.power(dr.maximum(value, 0), 1 / GAMMA) * PIECES
        piece = dr.minimum(mi.UInt32(place), PIECES - 1)
        index = piece + channel * (PIECES + 1)
        low, high = read_small(heights, index), read_small(heights, index + 1)
        height = dr.fma(high - low, place - mi.Float(piece), low)
        first = PIECES * read_small(heights, dr.full(mi.UInt32, channel * (PIECES + 1) + 1))
        slope = dr.power(first, GAMMA)
        return dr.power(dr.maximum(height, 1e-6), GAMMA) + slope * dr.minimum(value, 0)

    # ----------------------------------------------------------------------------- as numbers

    def gains(self) -> np.ndarray:
        """The gains e · w of training views, shape (views, 3)."""
        gains = np.ones((self.views, 3))
        if "exposure.log" in self._arrays:
            logs = self._array("exposure.log")
            gains *= np.exp(logs - logs[0])[:, None]
        if self.white_balance != "known":
            logs = self._array("white_balance.log").reshape(-1, 2)
            if self.white_balance == "per-image":
                logs = logs - logs[0]
            gains[:, [0, 2]] *= np.exp(logs)
        return gains

    def common_gain(self) -> np.ndarray:
        """The gain of a view that is none of the training views, of unknown exposure, (3,)."""
        return self.gains()[0] if self.white_balance == "common" else np.ones(3)

    def vignetting(self) -> np.ndarray | None:
        """The coefficients a, b, c; None where there are none."""
        known = "vignetting.terms" in self._arrays
        return self._array("vignetting.terms") * _ORDERS if known else None

    def falloff(self, radius2: np.ndarray) -> np.ndarray:
        """Vignetting v at squared radii."""
        terms = self.vignetting()
        if terms is None:
            return np.ones_like(radius2)
        a, b, c = terms
        return np.maximum(1 + radius2 * (a + radius2 * (b + radius2 * c)), _DARKEST)

    def curves(self) -> np.ndarray | None:
        """The curve f at `PIECES` + 1 places, shape (3, places); None where it is known.

        Photographs are u^2.2, with u from 0 to 1 in equal steps, and f(u^2.2) is value^2.2.
        """
        if not self.has_response:
            return None
        slopes = np.logaddexp(0, self._array("response.log").reshape(3, PIECES) + _UNIT)
        heights = np.concatenate([np.zeros((3, 1)), np.cumsum(slopes, 1)], 1)
        return 0.5 * heights / heights[:, PIECES // 2, None]

    def photographed(self, exposed: np.ndarray) -> np.ndarray:
        """The photograph of light times gain, the inverse of f; shape (..., 3)."""
        curves = self.curves()
        return exposed if curves is None else _through(exposed, curves, _places())

    def light(self, photograph: np.ndarray) -> np.ndarray:
        """Photographs through f, in NumPy; shape (..., 3)."""
        curves = self.curves()
        return photograph if curves is None else _through(photograph, _places(), curves)

    def _array(self, key: str) -> np.ndarray:
        return np.array(dr.detach(self._arrays[key]), np.float64)


def _places() -> np.ndarray:
    """Where `curves` are told, shape (3, places)."""
    return np.tile(np.linspace(0, 1, PIECES + 1), (3, 1))


def _through(values: np.ndarray, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Channels through curves of u, of which values are u^2.2; straight beyond both ends.

    Args:
        values: linear RGB, shape (..., 3).
        before, after: u at the ends of the pieces, shape (3, places), rising from 0.
    """
    found = []
    for x, y, channel in zip(before, after, np.moveaxis(values, -1, 0), strict=True):
        u = np.maximum(channel, 0) ** (1 / GAMMA)
        last = (y[-1] - y[-2]) / (x[-1] - x[-2])
        light = np.where(u > x[-1], y[-1] + (u - x[-1]) * last, np.interp(u, x, y)) ** GAMMA
        found.append(light + (y[1] / x[1]) ** GAMMA * np.minimum(channel, 0))
    return np.stack(found, -1).astype(values.dtype)


def _exp(log: mi.Float) -> mi.Float:
    # What is clipped keeps a gradient, which brings it back.
    return dr.exp(log + dr.detach(dr.clip(log, -BOUND, BOUND) - log))


def _softplus(x: mi.Float) -> mi.Float:
    return dr.maximum(x, 0) + dr.log(1 + dr.exp(-dr.abs(x)))
