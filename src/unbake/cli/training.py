"""Commands that train: `fit`, `solve`, `compare` and `reproduce`."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from rich.console import Console
from tyro.conf import OmitArgPrefixes, Positional, arg

from .. import backend, experiments, signals
from ..config import FitConfig, with_quality
from ..errors import UserError, quoted
from ..evaluation.settings import EvaluationSettings
from ..solver.settings import SolveSettings
from ..training.run_folder import RunFolder
from .console import say
from .flags import flags, given, with_options
from .options import (
    Count,
    Data,
    Experiment,
    File,
    Flag,
    Folder,
    FromRun,
    LightFlags,
    Methods,
    Out,
    Preset,
    Quality,
    Scale,
    Scenes,
    any_light,
    chosen_settings,
    exclude,
    exclude_changed,
    require,
    require_of_method,
    with_length,
)
from .processes import sharing_ranks

#: Between scores of a comparison, unless a file or an option says otherwise.
_SCORE_SECONDS = 5.0

if TYPE_CHECKING:
    FitFlags = SolveFlags = CompareFlags = Any
else:
    FitFlags = flags(FitConfig, presets=True)
    SolveFlags = flags(SolveSettings)
    CompareFlags = flags(FitConfig, presets=True, without=("method",))


def fit(
    data: Positional[Data],
    /,
    out: Out,
    preset: Preset = None,
    settings: File = None,
    quality: Quality = None,
    resume: Flag = False,
    clip_negative: Flag = False,
    allow_outside: Flag = False,
    allow_doubtful: Flag = False,
    tensorboard: Flag = False,
    radiance_from: Folder = None,
    *,
    fit: OmitArgPrefixes[FitFlags],
) -> int:
    """Recover materials or lighting from the photographs of a data set.

    Ctrl-C, SIGTERM, SIGHUP and a closed pipe stop it after the present step, with a checkpoint from
    which --resume continues. A second Ctrl-C ends it at once.

    Several processes share one fit with mpiexec -n 4 unbake fit DATA --out RUN (docs/machines.md).

    While it runs it tells the terms of its loss, smaller is better. photo: the photographs against
    the pictures of the unknowns; what remains in the end is mostly noise. prior: where L, the
    network that stands for all further light, breaks the rendering equation, at the first point
    that a camera sees; extra: the same one bounce further. These two keep the noise of one sample
    and need not fall. lhs: the photographs against L seen directly. In the end the error on pixels
    that were held aside tells whether the fit was still improving.

    Args:
        data: Folder of the data set, with its transforms.json.
        out: Folder to write the run to: settings, log, checkpoints, previews.
        preset: Settings to start from: cpu (default), paper (Sec. 5), release (the authors' code),
            release-lighting (theirs for an unknown environment map).
        settings: TOML file with settings, such as the config.toml of a run; instead of --preset.
        quality: How long the fit is: draft, a quarter of the length of the preset or the file;
            normal, the same; high, four times as long. --steps and --seconds take its place.
        resume: Go on with the run in --out; a larger --steps or --seconds makes it longer.
        clip_negative: Take negative pixels as zero instead of refusing them.
        allow_outside: Read files that the data set or its scene names outside of its folder.
        allow_doubtful: Begin also where poses seem to have other axes or units than the scene, or
            light seems to turn with the cameras.
        tensorboard: Write losses and scores to OUT/tensorboard, too, for tensorboard --logdir OUT.
        radiance_from: Folder that `unbake solve` wrote for this scene: L starts as it was solved
            there, with any materials, instead of untrained, and has its size.
        fit: Settings that differ from those of the preset or the file.
    """
    changes = given(fit)
    if resume:
        length = {"steps", "seconds"}
        others = {name: value for name, value in changes.items() if name not in length}
        others |= {"preset": preset, "settings": settings, "quality": quality}
        others["radiance-from"] = radiance_from
        others["clip-negative"] = clip_negative or None  # a run that goes on has its own
        exclude("resume", others)
        folder = RunFolder(out)
        folder.require_resumable()
        chosen = folder.settings()
    else:
        chosen = with_quality(chosen_settings(preset, settings), quality or "normal")
    chosen = with_length(chosen, changes)
    backend.activate()
    require_of_method(chosen, changes)
    from ..training.loop import fit as run_fit

    console = Console(highlight=False)
    with sharing_ranks() as ranks:
        progress = run_fit(
            data,
            out,
            chosen,
            resume=resume,
            clip_negative=clip_negative,
            allow_outside=allow_outside,
            allow_doubtful=allow_doubtful,
            tensorboard=tensorboard,
            radiance_from=radiance_from,
            console=console,
            ranks=ranks,
        )
    if not ranks.leads:
        return 0
    if (progress.seconds < chosen.seconds) if chosen.seconds else (progress.step < chosen.steps):
        return signals.status()
    if not progress.step:
        say(f"nothing was learned: the fields are untrained; next: unbake evaluate {quoted(out)}")
        return 0
    skipped = f" ({progress.skipped} skipped)" if progress.skipped else ""
    done = f"{progress.step} steps{skipped}, {progress.samples / 1e6:.1f} M samples in "
    say(f"{done}{progress.seconds:.0f} s; next: unbake evaluate {quoted(out)}")
    return 1 if progress.warning else 0


def solve(
    scene: Positional[Annotated[str | None, arg(metavar="[SCENE]", help_behavior_hint="")]] = None,
    /,
    *,
    out: Out,
    from_: FromRun = None,
    envmap: File = None,
    lights: File = None,
    cameras: File = None,
    allow_outside: Flag = False,
    solve: OmitArgPrefixes[SolveFlags],
    light: OmitArgPrefixes[LightFlags],
) -> int:
    """Learn the radiance of a scene whose materials and lights are known, without tracing paths.

    This is the forward problem, Neural Radiosity: a network L is trained until both sides of the
    rendering equation agree at random points of all surfaces. LHS shows L itself, RHS one bounce
    that ends in L. relMSE is the mean of (a - b)^2 / (b^2 + 0.01) over all pixels and channels of
    the pictures, b being path traced.

    With --from RUN the materials are those that a fit recovered, and L goes on from where the fit
    left it, also under another light: `unbake relight` without paths.

    Writes L (radiance.safetensors), pictures of both sides and of the reference, and relMSE over
    time (solve.json). L is written once a minute, and before the last pictures. Ctrl-C ends it
    early, with what was learned and pictures of --spp samples. `unbake fit --radiance-from` starts
    with such an L.

    Args:
        scene: A Mitsuba 3 XML file, or a built-in scene: demo, annex, still, cornell, cube,
            furnace.
        out: Folder to write to, new or empty.
        from_: Folder that `unbake fit` wrote, instead of a scene: pictures are of its held-out
            views, at most 512 pixels wide and high.
        envmap: Environment map (OpenEXR, HDR) to light the scene by, instead of its own light.
        lights: Mitsuba XML file with lights to use instead of the scene's own.
        cameras: Camera file (or transforms.json) of the pictures, instead of --views.
        allow_outside: Read files that the scene or --lights names outside of its folder.
        solve: How L is learned and measured.
        light: How the other light is put into the scene.
    """
    settings = with_options(SolveSettings(), given(solve))
    if cameras is not None:
        exclude_changed("cameras", SolveSettings, given(solve), "views")
    other = any_light(envmap, lights, given(light))
    if (scene is None) == (from_ is None):
        raise UserError("give a scene, or a run with --from, and not both", "solve")
    if from_ is not None:
        exclude_changed("from", SolveSettings, given(solve), "views", "resolution")
    backend.activate()
    from ..solver.solve import fine_tune
    from ..solver.solve import solve as run_solve

    console = Console(highlight=False)
    options: dict[str, Any] = {"allow_outside": allow_outside, "console": console, "tell": say}
    options |= {"cameras": cameras, "light": other}
    if from_ is not None:
        made = fine_tune(from_, out, settings, **options)
    else:
        made = run_solve(str(scene), out, settings, **options)
    last = made["measurements"][-1]
    say(f"{last['step']} steps in {last['seconds']:.0f} s; wrote {out}")
    return 0 if made["finished"] else signals.status()


def compare(
    data: Positional[Data],
    /,
    methods: Methods,
    out: Out,
    preset: Preset = None,
    settings: File = None,
    score_seconds: Annotated[float | None, arg(metavar="SECONDS", help_behavior_hint="")] = None,
    evaluate_spp: int = 32,
    evaluate_truth: Flag = False,
    clip_negative: Flag = False,
    allow_outside: Flag = False,
    allow_doubtful: Flag = False,
    *,
    compare: OmitArgPrefixes[CompareFlags],
) -> int:
    """Fit several methods to the same photographs, and compare their quality over time.

    Fields, batches, seed and length are the same for all. Learning rates and their decay,
    estimator, warm-up, Adam's beta2, bounces and the least slope of albedo are each method's own,
    unless the settings give them. Methods with a radiance field also search for roughness, where it
    is neural.

    Runs go to OUT/METHOD, tables to OUT/compare.json, a page to OUT/report.html. OUT/untrained has
    the fields before the first step: a method is worth what it adds to these. Where the data set
    has true maps, the same fields are first trained on these: the ceiling of every method. The same
    command again keeps finished runs and goes on with interrupted ones. A method that fails is
    recorded with its error; the exit status is then 1. With mpiexec, processes share the methods.

    Args:
        data: Folder of the data set, with its transforms.json.
        methods: Methods of `unbake fit`, such as: ours prb direct. METHOD:REPRESENTATION, such as
            prb:bitmap, also says how materials are represented (neural, grid, ...).
        out: Folder to write to.
        preset: Settings to start from: cpu (default), paper (Sec. 5), release (the authors' code),
            release-lighting (theirs for an unknown environment map).
        settings: TOML file with settings, such as the config.toml of a run; instead of --preset.
        score_seconds: Training time between scores on all held-out views (default: as the file
            says if that is more than 0, else 5; with 0 there are no scores).
        evaluate_spp: Samples per pixel of the final renderings.
        evaluate_truth: Render captured scenes with their true materials too.
        clip_negative: Take negative pixels as zero instead of refusing them.
        allow_outside: Read files that the data set or its scene names outside of its folder.
        allow_doubtful: Begin also where poses seem to have other axes or units than the scene, or
            light seems to turn with the cameras.
        compare: Settings of all methods that differ from those of the preset or the file.
    """
    require("evaluate-spp", evaluate_spp, 1)
    chosen = with_length(chosen_settings(preset, settings), given(compare))
    if score_seconds is None:
        score_seconds = chosen.score_seconds or _SCORE_SECONDS
    try:
        chosen = dataclasses.replace(chosen, score_seconds=score_seconds)
    except UserError as error:
        raise UserError(error.what, "--score-seconds") from None
    backend.activate()
    from ..comparison.compare import compare as run_compare
    from ..comparison.method_variant import MethodVariant

    variants = [MethodVariant.of(method) for method in methods]
    evaluation = EvaluationSettings(
        spp=evaluate_spp, clip_negative=clip_negative, truth=evaluate_truth
    )
    with sharing_ranks() as ranks:
        result = run_compare(
            data,
            variants,
            out,
            chosen,
            evaluation=evaluation,
            clip_negative=clip_negative,
            allow_outside=allow_outside,
            allow_doubtful=allow_doubtful,
            ranks=ranks,
        )
    if not ranks.leads:
        return 0
    say(f"wrote {out / 'compare.json'} and {out / 'report.html'}")
    rows = (result["untrained"], *result["methods"].values())
    return 1 if any("error" in row for row in rows) else 0


def reproduce(
    what: Positional[Experiment],
    /,
    scale: Scale = "cpu",
    out: Out = Path("reproduction"),
    scenes: Path = Path("scenes"),
    only: Scenes = (),
    seeds: Count = None,
    plan: Flag = False,
) -> None:
    """Make a table or a figure of the paper again: data, table and picture.

    Writes OUT/WHAT/data.json, data.csv, table.md and pictures. The same command continues what was
    stopped; data sets and fits are kept in OUT/work, and experiments share them.

    table1: scenes, views, path lengths. table2: path lengths in a cube. fig3: time of a step, by
    scene. fig4: gradients of a roughness. fig5: time and memory against albedo. fig6: materials of
    eight scenes (and fig. 1). fig7, fig8: the ablation, for materials and for lighting.

    Args:
        what: Which one.
        scale: smoke (seconds, to see that it runs), cpu (sized for two cores),
            or paper (for a GPU).
        out: Folder to write to, shared by all experiments.
        scenes: Folder of the published scenes, each in a folder or as .tar.xz.
        only: Folders of scenes, such as kitchen lego, for table1, fig3 and fig6: their results are
            of these alone (by default of all).
        seeds: Number of fits of each kind in fig6, fig7 and fig8 (by default three, two in rooms of
            fig6, and one at paper scale). More seeds later keep what is there.
        plan: Only tell what is left to do, and how long it will take on this machine.
    """
    backend.activate()
    from ..experiments.experiment import ExperimentContext
    from ..experiments.experiment import reproduce as run_reproduce

    if seeds is not None:
        require("seeds", seeds, 1)
    context = ExperimentContext(scale, out, scenes, seeds=seeds, only=only)
    with sharing_ranks() as ranks:
        run_reproduce(experiments.load(what), context, plan=plan, ranks=ranks)
