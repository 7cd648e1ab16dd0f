"""How fast each kind of unknown is learned, and how that changes over a fit."""

from __future__ import annotations

from ..config import FitConfig


def learning_rates(config: FitConfig, step: int, done: float) -> dict[str, float]:
    """Adam's rates, by the first word of a parameter's name; `radiance` is that of L_θ.

    All decay exponentially to a fraction of where they start. Those of the unknowns first rise, so
    that L_θ is never far behind: while it is wrong, albedo would run into its bounds.

    Args:
        step: steps taken so far.
        done: fraction of the fit that is done, [0,1].
    """
    decay = config.final_learning_rate ** min(done, 1.0)
    rise = min(1.0, (step + 1) / (config.warm_up + 1))
    albedo, roughness = config.learning_rate, config.roughness_learning_rate
    match config.representation:
        case "grid":
            albedo, roughness = config.grid.learning_rate, config.grid.roughness_learning_rate
        case "bitmap":
            albedo, roughness = config.bitmap.learning_rate, config.bitmap.roughness_learning_rate
    radiance = config.radiance_learning_rate
    if config.radiance_representation == "grid":
        radiance = config.grid.radiance_learning_rate
    unknowns = {
        "albedo": albedo,
        "roughness": roughness,
        "environment": config.lighting.learning_rate,
        "emission": config.lighting.learning_rate,
    }
    return {name: rate * decay * rise for name, rate in unknowns.items()} | {
        "radiance": radiance * decay
    }
