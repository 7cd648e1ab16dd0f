"""Learning rates of the unknowns over a fit."""

from __future__ import annotations

from ..config import FitConfig
from ..config.fit import OWN_FINAL_RATE, OWN_WARM_UP

#: Fraction of a fit over which the rates of what is unknown of cameras rise, as its square.
_CAMERA_WAITS = 0.2
#: Rates over that of exposures. Vignetting begins far from where it belongs. A response is told by
#: photographs of several exposures; what else a fit knows of it is mixed with albedo.
_CAMERA = {"vignetting": 4.0, "response": 0.0}


def learning_rates(config: FitConfig, step: int, done: float) -> dict[str, float]:
    """Adam's rates, by the first word of a parameter's name; `radiance` is that of L_θ.

    All decay exponentially to a fraction of where they start. Those of the unknowns are multiples
    of the fields' own rates, and first rise, so that L_θ is never far behind: while it is wrong,
    albedo would run into its bounds.

    Args:
        config: settings of a fit. Those that a fit was not started with may leave factors, warm-up
            and decay open, which are then those of methods with L_θ; see `with_defaults`.
        step: steps taken so far.
        done: fraction of the fit that is done, [0,1].
    """
    decay = (config.final_learning_rate or OWN_FINAL_RATE) ** min(done, 1.0)
    warm_up = OWN_WARM_UP if config.warm_up is None else config.warm_up
    rise = min(1.0, (step + 1) / (warm_up + 1))
    unknowns = {name: field.learning_rate for name, field in config.material_settings.items()}
    unknowns |= dict.fromkeys(("environment", "emission"), config.lighting.learning_rate)
    rates = {
        name: rate * (config.rate_factors[name] or 1.0) * decay * rise
        for name, rate in unknowns.items()
    }
    # Exposures begin near where they belong: while albedo is not, they would only move away.
    late = min(1.0, done / _CAMERA_WAITS) ** 2
    camera = config.camera
    for name in camera.of_light:
        rates[name] = camera.learning_rate * _CAMERA.get(name, 1.0) * decay * late
    rates |= dict.fromkeys(camera.of_places, camera.pose_learning_rate * decay * late)
    if config.objective.outliers == "found":
        rates["outliers"] = config.objective.learning_rate * late
    return rates | {"radiance": config.radiance_settings.learning_rate * decay}
