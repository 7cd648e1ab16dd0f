"""Regularizers of materials. They are not in the paper."""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi

from ..fields.materials import Material


def roughness_smoothness(here: Material, near: Material, valid: mi.Bool) -> mi.Float:
    """Mean absolute difference of the roughness of points and of others near them.

    Absolute rather than squared: borders between materials stay sharp.
    """
    difference = dr.abs(here["roughness"] - near["roughness"])
    return _mean(dr.select(valid, difference, 0), valid)


def albedo_smoothness(here: mi.Color3f, near: mi.Color3f, valid: mi.Bool) -> mi.Float:
    """Mean absolute difference of the albedo of points and of others near them, over channels."""
    difference = dr.mean(dr.abs(here - near))
    return _mean(dr.select(valid, difference, 0), valid)


def albedo_ties_roughness(
    here: Material, valid: mi.Bool, similarity: float, shift: int
) -> mi.Float:
    """Mean squared difference of the roughness of points with similar albedo.

    Lanes are paired with those `shift` further on. A pair counts by exp(−|Δalbedo|²/(2 σ²)).

    Args:
        similarity: σ, distance of linear RGB albedos.
        shift: lanes between the two of a pair.
    """
    lane = dr.arange(mi.UInt32, dr.width(valid))
    other = dr.select(lane + shift < dr.width(valid), lane + shift, lane + shift - dr.width(valid))
    albedo, roughness = dr.detach(here["albedo"]), here["roughness"]
    dr.eval(albedo, roughness, valid)
    distance = dr.squared_norm(albedo - dr.gather(mi.Color3f, albedo, other))
    both = valid & dr.gather(mi.Bool, valid, other)
    weight = dr.select(both, dr.exp(-distance / (2 * similarity**2)), 0)
    there = dr.gather(mi.Float, roughness, other)
    return _mean(weight * dr.square(roughness - there), both)


def mean_albedo_deviation(here: Material, valid: mi.Bool, mean: Sequence[float]) -> mi.Float:
    """Squared deviation of the mean albedo from a colour, summed over channels."""
    means = [_mean(dr.select(valid, channel, 0), valid) for channel in here["albedo"]]
    return sum(dr.square(m - wanted) for m, wanted in zip(means, mean, strict=True))


def _mean(values: mi.Float, counted: mi.Bool) -> mi.Float:
    return dr.sum(values) / dr.maximum(dr.sum(dr.select(counted, mi.Float(1), 0)), 1)
