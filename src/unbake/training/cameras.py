"""Radiance as photographs show it, by what is known and what was fitted of their cameras."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, final

import numpy as np

from ..dataset.camera import Camera
from ..dataset.views import View
from ..fields.camera import CameraModel

#: Pixels tell the exposure of a photograph where it and its rendering are brighter than this part
#: of their means.
_DARK = 0.01


@final
class Cameras:
    """The cameras of a data set.

    Args:
        model: what is fitted; None: all is as the data set tells.
        train: the training views, in the order of the model.
    """

    def __init__(self, model: CameraModel | None, train: Sequence[View]) -> None:
        self._model = model
        self._train = {view.name: number for number, view in enumerate(train)}

    @property
    def solves(self) -> bool:
        """Whether views that nothing was learned from have gains that only their photographs tell.

        Such a photograph is compared after its own exposure, and white balance if each image has
        one: that is not a prediction of how bright it is.
        """
        model = self._model
        if model is None:
            return False
        return model.white_balance == "per-image" or "exposure.log" in model.parameters()

    def gain(self, view: View, radiance: np.ndarray, photograph: np.ndarray) -> np.ndarray:
        """Exposure and white balance of a view over what the data set tells, linear RGB, (3,).

        Those of training views were fitted. Of other views they are the median ratio of photograph
        and rendering, over all pixels that are bright enough and not clipped.

        Args:
            radiance: rendering, linear RGB, shape (..., 3), with vignetting (`dimmed`).
            photograph: of the same pixels, as the file has it.
        """
        model = self._model
        if model is None:
            return np.ones(3)
        if view.name in self._train:
            return model.gains()[self._train[view.name]]
        common = model.common_gain()
        if not self.solves:
            return common
        coloured = model.white_balance == "per-image"
        return common * _ratio(model, view, radiance * common, photograph, coloured)

    def own_gain(self, view: View, radiance: np.ndarray, photograph: np.ndarray) -> np.ndarray:
        """The gain that brings any picture nearest to a photograph, whatever was fitted: as `gain`.

        Exposure and white balance are told by the two alone, as far as they were unknown to the
        fit. So it suits pictures that the fit has no part in.
        """
        model = self._model
        if model is None or not (self.solves or model.white_balance == "common"):
            return np.ones(3)
        coloured = model.white_balance != "known"
        found = _ratio(model, view, radiance.astype(np.float64), photograph, coloured)
        return found if self.solves else found / found[1]

    def dimmed(
        self, view: View, radiance: np.ndarray, numbers: np.ndarray | None = None
    ) -> np.ndarray:
        """Radiance with the vignetting of pixels.

        Args:
            radiance: (H, W, 3), or (n, ..., 3) of some pixels.
            numbers: of these, row by row, shape (n,).
        """
        if self._model is None or self._model.vignetting() is None:
            return radiance
        falloff = self._model.falloff(radius2(view.camera, numbers))
        shape = radiance.shape[:2] if numbers is None else (-1,)
        falloff = falloff.reshape(*shape, *[1] * (radiance.ndim - len(shape)))
        return (radiance * falloff).astype(radiance.dtype)

    def photographed(self, view: View, dimmed: np.ndarray, gain: np.ndarray) -> np.ndarray:
        """What the photograph would show: see `View.photographed`.

        Args:
            dimmed: from `dimmed`.
            gain: from `gain`.
        """
        if self._model is None:
            return view.photographed(dimmed)
        exposed = (dimmed * (gain * view.exposure)).astype(dimmed.dtype)
        return view.readable(self._model.photographed(exposed))

    def told(self) -> dict[str, Any]:
        """What was fitted, as numbers of `metrics.json`; empty where nothing was."""
        model = self._model
        if model is None:
            return {}
        found: dict[str, Any] = {}
        if model.white_balance == "common":
            red, _, blue = model.common_gain()
            found["white_balance"] = {"red": float(red), "blue": float(blue)}
        if (terms := model.vignetting()) is not None:
            found["vignetting"] = dict(zip("abc", map(float, terms), strict=True))
        if (curves := model.curves()) is not None:
            found["response"] = dict(zip(("red", "green", "blue"), curves.tolist(), strict=True))
        return found

    def told_of(self, view: View, gain: np.ndarray) -> dict[str, Any]:
        """The exposure of a view, and its white balance if it has one of its own.

        Args:
            gain: of the view.
        """
        assert self._model is not None
        own = self._model.white_balance == "per-image"
        scale = float(gain[1] if own else gain[1] / self._model.common_gain()[1])
        row: dict[str, Any] = {
            "told": view.exposure,
            "exposure": view.exposure * scale,
            "stops": float(np.log2(scale)),
        }
        if own:
            row |= {"red": float(gain[0] / gain[1]), "blue": float(gain[2] / gain[1])}
        return row


def _ratio(
    model: CameraModel, view: View, expected: np.ndarray, photograph: np.ndarray, coloured: bool
) -> np.ndarray:
    """The median ratio of a photograph and what was expected, of each channel or of all, (3,).

    It is that of pixels that are bright enough and not clipped; 1 where there are none.

    Args:
        model: tells the response.
        expected: radiance, float64, shape (..., 3).
        photograph: of the same pixels, as the file has it.
        coloured: whether channels have ratios of their own.
    """
    limit = np.inf if view.clipped is None else view.clipped
    light = model.light(photograph.astype(np.float64)).reshape(-1, 3) / view.exposure
    expected = expected.reshape(-1, 3)
    finite = np.isfinite(light + expected).min(axis=-1)
    if not finite.any():
        return np.ones(3)
    bright = [x > _DARK * x[finite].mean() for x in (light, expected)]
    told = finite[:, None] & bright[0] & bright[1] & (photograph.reshape(-1, 3) < limit)
    ratios = np.log(np.where(told, light, 1)) - np.log(np.where(told, expected, 1))
    if coloured and told.any(0).all():
        return np.exp([np.median(r[t]) for r, t in zip(ratios.T, told.T, strict=True)])
    return np.full(3, np.exp(np.median(ratios[told])) if told.any() else 1.0)


def radius2(camera: Camera, numbers: np.ndarray | None = None) -> np.ndarray:
    """As `CameraRays.radius2`, of a camera's pixels by number, row by row; None: of all."""
    if numbers is None:
        numbers = np.arange(camera.width * camera.height)
    y, x = np.divmod(np.asarray(numbers, np.int64), camera.width)
    x, y = x + 0.5 - camera.cx, y + 0.5 - camera.cy
    return 4 * (x**2 + y**2) / (camera.width**2 + camera.height**2)
