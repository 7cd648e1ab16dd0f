"""unbake: materials or lighting from photographs, with the global illumination taken out.

The public names below are loaded when they are first used, after a Mitsuba variant has been chosen
with `activate`:

    import unbake
    unbake.activate()
    unbake.capture("demo", Path("data"), unbake.CaptureSettings())
    unbake.fit(Path("data"), Path("run"), unbake.preset("cpu"))
    unbake.evaluate(Path("run"))
    unbake.write_report([Path("run")], Path("report.html"))
"""

from __future__ import annotations

import importlib

__version__ = "0.1.0"

_HOME = {
    "activate": "backend",
    "FitConfig": "config",
    "preset": "config",
    "read_toml": "config",
    "to_toml": "config",
    "UserError": "errors",
    "CaptureSettings": "acquisition.capture",
    "capture": "acquisition.capture",
    "Dataset": "dataset.views",
    "fit": "training.loop",
    "load_run": "training.recovered",
    "EvaluationSettings": "evaluation.evaluate",
    "evaluate": "evaluation.evaluate",
    "write_report": "report.page",
}

__all__ = sorted(_HOME)


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f".{_HOME[name]}", __name__), name)


def __dir__() -> list[str]:
    return [*globals(), *__all__]
