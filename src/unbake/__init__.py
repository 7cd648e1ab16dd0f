"""Recovers materials or lighting from photographs, with the global illumination taken out.

    import unbake

    unbake.activate()
    unbake.capture("demo", "data", unbake.CaptureSettings())
    unbake.fit("data", "run", unbake.preset("cpu"))
    unbake.evaluate("run")
    unbake.write_report(["run"], "report.html")
    unbake.export("run", "exported")
    unbake.relight("run", "relit", unbake.LightConfig(envmap="sky.exr"))

Paths may be given as `str` or as `Path`.

`import unbake` loads neither Mitsuba nor Dr.Jit. A public name is loaded when it is first used; if
it needs Mitsuba and no variant has been chosen, `activate()` chooses one for this machine.
"""

from __future__ import annotations

import importlib
from textwrap import wrap
from typing import TYPE_CHECKING

import unbake.version as _version

from .errors import UserError as UserError

if TYPE_CHECKING:
    from .acquisition.capture import capture as capture
    from .acquisition.degrade import degrade as degrade
    from .acquisition.settings import CaptureSettings as CaptureSettings
    from .acquisition.settings import DegradeSettings as DegradeSettings
    from .backend import activate as activate
    from .checks.check import check_data as check_data
    from .comparison.compare import compare as compare
    from .comparison.method_variant import MethodVariant as MethodVariant
    from .config import FitConfig as FitConfig
    from .config import preset as preset
    from .config import read_toml as read_toml
    from .config import to_toml as to_toml
    from .config.light import LightConfig as LightConfig
    from .dataset.camera import Camera as Camera
    from .dataset.data_folder import DataFolder as DataFolder
    from .dataset.photographs import Photographs as Photographs
    from .dataset.pixels import CameraRays as CameraRays
    from .dataset.pixels import PixelBatch as PixelBatch
    from .dataset.pixels import PixelSource as PixelSource
    from .dataset.pixels import RayBatch as RayBatch
    from .dataset.views import Dataset as Dataset
    from .dataset.views import View as View
    from .evaluation.evaluate import evaluate as evaluate
    from .evaluation.rendering import relight as relight
    from .evaluation.rendering import render as render
    from .evaluation.settings import EvaluationSettings as EvaluationSettings
    from .evaluation.settings import RenderSettings as RenderSettings
    from .exports.export import export as export
    from .fields.domain import SurfacePoint as SurfacePoint
    from .fields.field import Cost as Cost
    from .fields.field import Field as Field
    from .fields.field import FieldSpec as FieldSpec
    from .fields.materials import Material as Material
    from .fields.materials import Materials as Materials
    from .fields.perceptron import Perceptron as Perceptron
    from .fields.radiance import RadianceField as RadianceField
    from .fields.registry import Representation as Representation
    from .fields.registry import register_representation as register_representation
    from .fields.settings import BitmapConfig as BitmapConfig
    from .fields.settings import DenseGridConfig as DenseGridConfig
    from .fields.settings import GridConfig as GridConfig
    from .fields.settings import NetworkConfig as NetworkConfig
    from .fields.settings import TriPlaneConfig as TriPlaneConfig
    from .fields.torch import TorchField as TorchField
    from .importing.import_data import import_data as import_data
    from .importing.settings import ImportSettings as ImportSettings
    from .quantities import DEFAULT_QUANTITIES as DEFAULT_QUANTITIES
    from .quantities import QUANTITIES as QUANTITIES
    from .quantities import Quantity as Quantity
    from .report.page import write_report as write_report
    from .run import Run as Run
    from .solver.settings import SolveSettings as SolveSettings
    from .solver.solve import fine_tune as fine_tune
    from .solver.solve import solve as solve
    from .training.checkpoint import Progress as Progress
    from .training.checkpoint import load_checkpoint as load_checkpoint
    from .training.checkpoint import save_checkpoint as save_checkpoint
    from .training.defaults import with_defaults as with_defaults
    from .training.loop import fit as fit
    from .training.path_depth import with_path_depth as with_path_depth
    from .training.problem import Problem as Problem
    from .training.problem import make_problem as make_problem
    from .training.problem import training_pixels as training_pixels
    from .training.recovered import Recovered as Recovered
    from .training.recovered import load_run as load_run
    from .training.run_folder import Origin as Origin
    from .training.run_folder import RunFolder as RunFolder
    from .training.schedule import learning_rates as learning_rates
    from .training.solved import load_radiance as load_radiance
    from .training.state import State as State
    from .training.state import initial_state as initial_state
    from .training.step import TrainingStep as TrainingStep
    from .transport.loss import RelativeL2 as RelativeL2
    from .transport.loss import pixel_means as pixel_means
    from .transport.loss import squared_error as squared_error
    from .transport.methods import METHODS as METHODS
    from .transport.methods import Attached as Attached
    from .transport.methods import Method as Method
    from .transport.methods import register_method as register_method
    from .transport.objective import objective as objective
    from .transport.objective import requirements as requirements
    from .transport.path_sample import PathSample as PathSample
    from .transport.path_sample import Requirements as Requirements
    from .transport.path_sample import lhs as lhs
    from .transport.path_sample import rhs as rhs
    from .transport.path_sample import trace as trace
    from .transport.path_tracer import path_traced as path_traced
    from .transport.prior import residual as residual
    from .transport.prior import residual_norm as residual_norm
    from .transport.render import render_radiance as render_radiance
    from .transport.samplers import PathSampler as PathSampler
    from .transport.samplers import SamplerContext as SamplerContext
    from .transport.samplers import register_sampler as register_sampler
    from .transport.terms import TERMS as TERMS
    from .transport.terms import Term as Term
    from .transport.terms import TermInputs as TermInputs
    from .transport.terms import register_term as register_term
    from .transport.vertex import SceneView as SceneView
    from .transport.vertex import Vertex as Vertex

__version__ = _version.VERSION

# The public names by task and module. A new one goes here and, for type checkers, into the block
# above.
_GROUPS: dict[str, dict[str, tuple[str, ...]]] = {
    "The commands": {
        "backend": ("activate",),
        "errors": ("UserError",),
        "config": ("FitConfig", "preset", "read_toml", "to_toml"),
        "acquisition.settings": ("CaptureSettings", "DegradeSettings"),
        "acquisition.capture": ("capture",),
        "importing.settings": ("ImportSettings",),
        "importing.import_data": ("import_data",),
        "acquisition.degrade": ("degrade",),
        "checks.check": ("check_data",),
        "training.loop": ("fit",),
        "training.recovered": ("Recovered", "load_run"),
        "run": ("Run",),
        "evaluation.settings": ("EvaluationSettings", "RenderSettings"),
        "evaluation.evaluate": ("evaluate",),
        "config.light": ("LightConfig",),
        "evaluation.rendering": ("relight", "render"),
        "report.page": ("write_report",),
        "exports.export": ("export",),
        "solver.settings": ("SolveSettings",),
        "solver.solve": ("fine_tune", "solve"),
        "training.solved": ("load_radiance",),
        "comparison.compare": ("compare",),
        "comparison.method_variant": ("MethodVariant",),
    },
    "Data sets": {
        "dataset.camera": ("Camera",),
        "dataset.data_folder": ("DataFolder",),
        "dataset.photographs": ("Photographs",),
        "dataset.pixels": ("CameraRays", "PixelBatch", "PixelSource", "RayBatch"),
        "dataset.views": ("Dataset", "View"),
    },
    "Unknowns (fields on surfaces)": {
        "fields.domain": ("SurfacePoint",),
        "fields.field": ("Cost", "Field", "FieldSpec"),
        "fields.materials": ("Material", "Materials"),
        "fields.perceptron": ("Perceptron",),
        "fields.radiance": ("RadianceField",),
        "fields.registry": ("Representation", "register_representation"),
        "fields.settings": (
            "BitmapConfig",
            "DenseGridConfig",
            "GridConfig",
            "NetworkConfig",
            "TriPlaneConfig",
        ),
        "fields.torch": ("TorchField",),
        "quantities": ("DEFAULT_QUANTITIES", "QUANTITIES", "Quantity"),
    },
    "Light transport and the objective": {
        "transport.loss": ("RelativeL2", "pixel_means", "squared_error"),
        "transport.methods": ("METHODS", "Attached", "Method", "register_method"),
        "transport.objective": ("objective", "requirements"),
        "transport.path_sample": ("PathSample", "Requirements", "lhs", "rhs", "trace"),
        "transport.path_tracer": ("path_traced",),
        "transport.prior": ("residual", "residual_norm"),
        "transport.render": ("render_radiance",),
        "transport.samplers": ("PathSampler", "SamplerContext", "register_sampler"),
        "transport.terms": ("TERMS", "Term", "TermInputs", "register_term"),
        "transport.vertex": ("SceneView", "Vertex"),
    },
    "The parts of a training loop": {
        "training.checkpoint": ("Progress", "load_checkpoint", "save_checkpoint"),
        "training.defaults": ("with_defaults",),
        "training.path_depth": ("with_path_depth",),
        "training.problem": ("Problem", "make_problem", "training_pixels"),
        "training.run_folder": ("Origin", "RunFolder"),
        "training.schedule": ("learning_rates",),
        "training.state": ("State", "initial_state"),
        "training.step": ("TrainingStep",),
    },
}
_MODULES = {module: names for group in _GROUPS.values() for module, names in group.items()}
_HOME = {name: module for module, names in _MODULES.items() for name in names}

# Modules above that are imported without Mitsuba.
_PURE = frozenset(
    {
        "acquisition.settings",
        "evaluation.settings",
        "backend",
        "config",
        "config.light",
        "errors",
        "fields.field",
        "fields.registry",
        "fields.settings",
        "importing.settings",
        "quantities",
        "solver.settings",
        "transport.methods",
    }
)

__all__ = sorted(_HOME)  # pyright: ignore[reportUnsupportedDunderAll]


def _listed() -> str:
    """The public names by task, which `help` shows also where no variant can be chosen."""
    lines = ["", "Public names:", ""]
    for task, modules in _GROUPS.items():
        names = ", ".join(sorted((n for group in modules.values() for n in group), key=str.lower))
        lines += [f"  {task}:", *wrap(names, 92, initial_indent=" " * 4, subsequent_indent=" " * 4)]
    return "\n".join(lines) + "\n"


__doc__ = (__doc__ or "") + _listed()


class _NoVariant(UserError, AttributeError):
    """No variant runs here. As an AttributeError too, so that `help` and `hasattr` go on."""


def __getattr__(name: str) -> object:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = _HOME[name]
    if module not in _PURE:
        from .backend import activate

        try:
            activate()
        except UserError as error:
            raise _NoVariant(error.what, error.where, error.remedy) from None
    return getattr(importlib.import_module(f".{module}", __name__), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
