"""`unbake bench`: what measures steps, gradients, learning rates and fields."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console
from tyro.conf import Positional, arg

from .. import backend
from ..config import FitConfig, PresetName
from ..errors import UserError
from ..io import require_writable_file
from ..training.run_folder import RunFolder
from .console import say
from .flags import with_options
from .options import (
    Count,
    Data,
    File,
    Flag,
    Folder,
    Methods,
    OutFile,
    Preset,
    RequiredFile,
    Run,
    Seconds,
    chosen_settings,
    exclude,
    require,
    with_length,
)
from .processes import sharing_ranks

#: Of all of them.
SUMMARY = "Measure the training step, its gradients, learning rates, or the ceiling of the fields"

Method = Annotated[str, arg(metavar="METHOD")]
SmallScene = Annotated[str | None, arg(metavar="SCENE", help_behavior_hint="")]
Seeds = Annotated[tuple[int, ...], arg(metavar="SEEDS", help_behavior_hint="(default: 0)")]
DataSets = Annotated[tuple[Path, ...], arg(metavar="FOLDERS", help_behavior_hint="(required)")]
#: The least number of steps that a median is taken of.
_FEWEST = 10


def _ready(
    data: Path | None,
    scene: str | None,
    steps: int,
    preset: PresetName | None,
    settings: Path | None,
    out: Path | None,
) -> FitConfig:
    """The settings that steps are measured with, once the options are known to be good.

    A variant is active from then on.
    """
    if data is not None:
        exclude("data", {"scene": scene})
    chosen = chosen_settings(preset, settings)
    require("steps", steps, _FEWEST)
    require_writable_file(out)
    backend.activate()
    return chosen


def step(
    data: Folder = None,
    scene: SmallScene = None,
    method: Method = "ours",
    steps: int = 100,
    preset: Preset = None,
    settings: File = None,
    clip_negative: Flag = False,
    allow_outside: Flag = False,
    out: OutFile = None,
) -> None:
    """Take the step of one method apart: samples a second, and where the time goes.

    Args:
        data: Folder of a data set.
        scene: Without --data: a scene to render a small data set of (default: demo).
        method: METHOD, METHOD:REPRESENTATION or METHOD:REPRESENTATION:ESTIMATOR, such as prb or
            prb:bitmap:all-pairs.
        steps: Steps to take the median of, after warm-up.
        preset: Settings to measure: cpu (default), paper (Sec. 5), release (the authors' code),
            release-lighting (theirs for an unknown environment map).
        settings: TOML file with settings; instead of --preset.
        clip_negative: Take negative pixels as zero instead of refusing them.
        allow_outside: Read files that the data set or a scene names outside of its folder.
        out: JSON file to write the numbers to.
    """
    chosen = _ready(data, scene, steps, preset, settings, out)
    from ..comparison.method_variant import MethodVariant
    from ..profiling.bench_step import bench_step, small_data

    try:
        variant = MethodVariant.of(method)
    except UserError as error:
        raise UserError(error.what, "--method", error.remedy) from None
    config, console = variant.settings(chosen), Console(highlight=False)
    reading: Any = {"clip_negative": clip_negative, "allow_outside": allow_outside}
    with small_data(data, scene or "demo", allow_outside=allow_outside) as small:
        bench_step(small, config, steps, out, console, **reading)


def methods(
    methods: Methods,
    data: Folder = None,
    scene: SmallScene = None,
    steps: int = 100,
    preset: Preset = None,
    settings: File = None,
    clip_negative: Flag = False,
    allow_outside: Flag = False,
    out: OutFile = None,
) -> int:
    """Measure the steps of several methods side by side, in turn.

    The exit status is 1 where a method failed.

    Args:
        methods: METHOD, METHOD:REPRESENTATION or METHOD:REPRESENTATION:ESTIMATOR, such as ours prb
            prb:bitmap prb:bitmap:all-pairs.
        data: Folder of a data set.
        scene: Without --data: a scene to render a small data set of (default: demo).
        steps: Steps to take the median of, after warm-up.
        preset: Settings to measure: cpu (default), paper (Sec. 5), release (the authors' code),
            release-lighting (theirs for an unknown environment map).
        settings: TOML file with settings; instead of --preset.
        clip_negative: Take negative pixels as zero instead of refusing them.
        allow_outside: Read files that the data set or a scene names outside of its folder.
        out: JSON file to write the numbers to.
    """
    chosen = _ready(data, scene, steps, preset, settings, out)
    from ..comparison.bench_methods import bench_methods
    from ..comparison.method_variant import MethodVariant
    from ..profiling.bench_step import small_data

    variants = [MethodVariant.of(method) for method in methods]
    console = Console(highlight=False)
    reading: Any = {"clip_negative": clip_negative, "allow_outside": allow_outside}
    with small_data(data, scene or "demo", allow_outside=allow_outside) as small:
        found = bench_methods(small, variants, chosen, steps, out, console, **reading)
    return 1 if any("error" in row for row in found["rows"]) else 0


def rates(
    data: DataSets,
    methods: Methods,
    out: RequiredFile,
    steps: Count = None,
    seconds: Seconds = None,
    seeds: Seeds = (0,),
    schedule: Flag = False,
    preset: Preset = None,
    settings: File = None,
    clip_negative: Flag = False,
    allow_outside: Flag = False,
) -> None:
    """Search the learning rates of methods, by fits that are scored on held-out views.

    Each method is searched on each data set, and so is the estimator of those that follow paths.
    The same command goes on after the fits that --out has. Processes that mpiexec starts share the
    searches.

    Args:
        data: Folders of data sets.
        methods: METHOD, METHOD:REPRESENTATION or METHOD:REPRESENTATION:ESTIMATOR, such as ours prb
            prb:bitmap prb:bitmap:all-pairs.
        out: JSON file to write all fits to.
        steps: Length of a fit (default: as in the settings).
        seconds: Length of a fit in seconds of training, instead of steps.
        seeds: Seeds of the fits whose scores are averaged, such as 0 1 2.
        schedule: Also search how far all rates fall, and the warm-up of the unknowns.
        preset: Settings to begin with: cpu (default), paper (Sec. 5), release (the authors' code),
            release-lighting (theirs for an unknown environment map).
        settings: TOML file with settings; instead of --preset.
        clip_negative: Take negative pixels as zero instead of refusing them.
        allow_outside: Read files that data sets or their scenes name outside of their folders.
    """
    length = {"steps": steps, "seconds": seconds}
    chosen = chosen_settings(preset, settings)
    chosen = with_length(chosen, {k: v for k, v in length.items() if v is not None})
    if not chosen.steps and not chosen.seconds:
        raise UserError("must be 1 or more, not 0", "--steps")
    for seed in seeds:
        require("seeds", seed, 0)
    with sharing_ranks() as ranks:
        backend.activate()
        from ..comparison.bench_rates import bench_rates
        from ..comparison.method_variant import MethodVariant

        variants = [MethodVariant.of(method) for method in methods]
        console = Console(highlight=False)
        ranks.together(lambda: require_writable_file(out) if ranks.leads else None)
        bench_rates(
            data,
            variants,
            chosen,
            out,
            console,
            seeds,
            schedule=schedule,
            clip_negative=clip_negative,
            allow_outside=allow_outside,
            ranks=ranks,
        )
    if ranks.leads:
        say(f"wrote {out}")


def gradients(
    run: Positional[Run],
    /,
    batches: int = 64,
    batch: Count = None,
    spp: Count = None,
    allow_outside: Flag = False,
    out: OutFile = None,
) -> None:
    """Measure the slope of the loss towards the true values, and the signal to noise of a batch.

    The run must be of a data set with true materials. The slope is that of the way from the fitted
    to the true values of a quantity. Signal to noise is told of it, and of the gradients by the
    fields' parameters.

    Args:
        run: Folder of the run.
        batches: How many to measure.
        batch: Pixels in a batch (default: as in the run).
        spp: Samples per pixel (default: as in the run).
        allow_outside: Read files that the data set or its scene names outside of its folder.
        out: JSON file to write the numbers to.
    """
    folder = RunFolder(run)
    folder.require_fitted()
    changes = {name: x for name, x in {"batch": batch, "spp": spp}.items() if x is not None}
    config = with_options(folder.settings(), changes)
    require_writable_file(out)
    backend.activate()
    from ..profiling.bench_gradients import FEWEST, bench_gradients

    require("batches", batches, FEWEST)
    console = Console(highlight=False)
    bench_gradients(run, config, batches, out, console, allow_outside=allow_outside)


def ceiling(
    data: Positional[Data],
    /,
    steps: Count = None,
    allow_outside: Flag = False,
    preset: Preset = None,
    settings: File = None,
    out: OutFile = None,
) -> None:
    """Train fields on the true maps, and score them: what a fit can reach at best.

    The data set must have true maps. The fields of the settings are trained on those of the
    training views, without rendering, and scored on held-out views: no fit with them can be
    expected to be better. `unbake evaluate` then shows it beside a result.

    Args:
        data: Folder of the data set.
        steps: Steps on the true maps (default: as many as they need).
        allow_outside: Read files that the data set or its scene names outside of its folder.
        preset: Settings of the fields: cpu (default), paper (Sec. 5), release (the authors' code),
            release-lighting (theirs for an unknown environment map).
        settings: TOML file with settings; instead of --preset.
        out: JSON file to write the numbers to.
    """
    chosen = chosen_settings(preset, settings)
    if steps is not None:
        require("steps", steps, _FEWEST)
    require_writable_file(out)
    backend.activate()
    from ..profiling.bench_ceiling import bench_ceiling

    bench_ceiling(data, chosen, steps, out, Console(highlight=False), allow_outside=allow_outside)


#: By the word after `bench`, in the order of the help.
MEASUREMENTS: Mapping[str, Callable[..., int | None]] = {
    "step": step,
    "methods": methods,
    "rates": rates,
    "gradients": gradients,
    "ceiling": ceiling,
}
