"""A coarse grid over position and brightness of the albedo: what a surface shares with its like."""

from __future__ import annotations

import drjit as dr
import drjit.nn as nn
import mitsuba as mi

from .domain import SurfacePoint, bounded
from .settings import GuideConfig


class Guide:
    """A function of position and albedo, added to the outputs of a field before their bounds.

    Photographs tell little of roughness at a point. Points near each other whose albedo is equally
    bright are mostly of one material, and here they share a value: gradients of many pixels meet in
    each number. The network, which learns slower beside it, adds what differs within.

    Each level of a grid over positions has a number for each of some brightnesses. Between corners
    and between brightnesses it is linear. Brightness is the square root of the mean of linear RGB
    albedo, in which steps look alike. The albedo is a constant: it is not pulled to where roughness
    would have it.

    Args:
        settings: sizes.
        outputs: of the field.
    """

    def __init__(self, settings: GuideConfig, outputs: int) -> None:
        self._settings = settings
        self._outputs = outputs
        bins = settings.brightnesses
        self._grids = [
            nn.HashGridEncoding(
                mi.Float,
                3,
                n_levels=settings.levels,
                n_features_per_level=bins,
                hashmap_size=settings.numbers(1),
                base_resolution=settings.base_resolution + 1,
                per_level_scale=2.0,
            )
            for _ in range(outputs)
        ]
        for grid in self._grids:
            grid.data = dr.zeros(mi.Float, grid.n_params)
            dr.make_opaque(grid.data)

    def parameters(self) -> dict[str, mi.Float]:
        """`guide.0`, …: the numbers of each output."""
        return {f"guide.{i}": grid.data for i, grid in enumerate(self._grids)}

    def assign(self, parameters: dict[str, mi.Float | mi.TensorXf]) -> None:
        """Use these arrays from now on; others than those of `parameters` are ignored."""
        for i, grid in enumerate(self._grids):
            grid.data = parameters[f"guide.{i}"]

    def evaluate(self, point: SurfacePoint) -> list[mi.Float]:
        """One number for each output; where the albedo is not told, all are taken as mid-grey."""
        s = self._settings
        weights = _hats(point.albedo, s.brightnesses)
        position = list(point.position)
        values = []
        for grid in self._grids:
            features = grid(position)
            value = mi.Float(0)
            for level in range(s.levels):
                share = s.gain * s.falloff**level
                for i, weight in enumerate(weights):
                    value = dr.fma(share * weight, features[level * s.brightnesses + i], value)
            values.append(value)
        return values

    @property
    def features(self) -> int:
        """Numbers that are looked up at each corner of a cell, over all levels."""
        return self._outputs * self._settings.levels * self._settings.brightnesses


def _hats(albedo: mi.Color3f | None, count: int) -> list[mi.Float]:
    """Weights of `count` brightnesses from 0 to 1, of which two are not zero; their sum is one."""
    mean = mi.Float(0.25) if albedo is None else dr.mean(dr.detach(albedo))
    at = dr.sqrt(bounded(mean, 0, 1)) * (count - 1)
    return [bounded(1 - dr.abs(at - i), 0, 1) for i in range(count)]
