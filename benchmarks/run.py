"""Every comparison of docs/comparison.md, and the machine's numbers of docs/performance.md.

    python benchmarks/run.py [JOB ...] [--plan] [--scale smoke]

Jobs: machine steps demo rivals equal long staircase ablation lighting emission sparse prior rates
rates-check (default: all; hours). What `rates` finds changes the other jobs when it is in
`METHOD_DEFAULTS`. STAIRCASE takes part where --staircase, or STAIRCASE of the environment, names
its data set (docs/staircase.md says how to make it). Data sets, runs and records of jobs are kept
in --out, so that the same command continues what was stopped. Results go to --results; `python
benchmarks/tables.py` prints them as tables. Methods are compared over three seeds, over two at
equal time: results have the mean of a number, and its sample standard deviation as NUMBER_sd.
"""

from __future__ import annotations

import argparse
import os
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from here import ROOT

from rich.console import Console
from summary import machine_results, read, summarized, summary

from unbake.acquisition.settings import LIGHT_PIXELS, LIGHT_SAMPLES
from unbake.config import from_toml, method_defaults, with_method
from unbake.dataset.data_folder import DataFolder
from unbake.errors import UserError
from unbake.experiments.commands import call_settings, end_of_call, main, run_jobs, unbake
from unbake.experiments.jobs import Findings, Job, JobRunner, Unfinished, digest
from unbake.experiments.scales import SMOKE
from unbake.io import write_atomically, write_json

RESULTS = ROOT / "benchmarks" / "results"
STAIRCASE = "staircase"

# ---------------------------------------------------------------------------------------- The jobs

#: Of every comparison of methods.
SEEDS = (0, 1, 2)
#: Of those at equal time, which take longest.
SEEDS_AT_TIME = (0, 1)


@dataclass(frozen=True)
class Capture:
    """A data set of a built-in scene, as `unbake capture` renders it."""

    scene: str
    views: int = 24
    held_out: int = 4
    resolution: int = 128
    spp: int = 100
    cameras: str | None = None  #: a camera file in `benchmarks`, instead of `views` and `held_out`

    @property
    def samples(self) -> int:
        """Camera samples of all photographs."""
        return (self.views + self.held_out) * self.resolution**2 * self.spp


DATA = {
    "demo": Capture("demo"),
    "still": Capture("still", views=25, spp=400),
    "few": Capture("demo", views=6),
    "three": Capture("demo", views=3),
    # Cameras at x > 2 m that look towards +x; held-out ones look both ways by turns.
    "half": Capture("demo", views=12, held_out=8, cameras="prior/half.json"),
    "annex": Capture("annex", views=16, held_out=6, resolution=96, spp=625),
    # A room and an object to search for rates.
    "cornell": Capture("cornell", views=12, held_out=4, resolution=96, spp=128),
    "small-still": Capture("still", views=12, held_out=4, resolution=96, spp=128),
}


@dataclass(frozen=True)
class Compare:
    """`unbake compare` of methods, summarized over seeds in a file of results.

    Args:
        job: the job that it belongs to.
        data: a key of `DATA`, or STAIRCASE.
        methods: as `unbake compare` reads them.
        steps: length of each fit; 0 if `seconds` is given.
        seconds: length of each fit.
        seeds: each is a comparison of its own.
        options: further options of `unbake compare`.
        settings: TOML file of settings, relative to `benchmarks`.
        groups: names of groups of held-out views, which take turns: the first view belongs to the
            first group. Each is also scored by itself.
    """

    job: str
    data: str
    methods: Sequence[str]
    steps: int = 0
    seconds: int = 0
    seeds: Sequence[int] = SEEDS
    options: Sequence[object] = ()
    settings: str | None = None
    groups: Sequence[str] = ()


@dataclass(frozen=True)
class EqualSamples:
    """Methods with as many camera samples as a slower one traced in its time, seed by seed.

    Their schedules have this length: rates decay until the last sample. The slow method's row is
    that of its own fit.

    Args:
        job: the job that it belongs to.
        methods: as `unbake compare` reads them; all trace the same number of samples in a step.
        like: name of the comparison at equal time that has the slow method, and its settings.
        slow: name of the slow method's run.
    """

    job: str
    methods: Sequence[str]
    like: str
    slow: str


@dataclass(frozen=True)
class Steps:
    """`unbake bench methods`: the step times of methods side by side."""

    job: str
    data: str
    methods: Sequence[str]
    settings: str | None = None


@dataclass(frozen=True)
class Machine:
    """`unbake bench step` of several methods and data sets, in the file of this machine.

    Args:
        cases: methods, data, settings and number of steps of each.
    """

    job: str
    cases: Sequence[tuple[str, str, str | None, int]]


@dataclass(frozen=True)
class Rates:
    """`unbake bench rates`: a search for each method, all in one file.

    Args:
        job: the job that it belongs to.
        data: keys of `DATA`; each is searched by itself.
        seconds: by method, as `unbake bench rates` reads it, the length of each fit. A search that
            chooses between estimators needs equal time.
        steps: by method, the length of each fit of the others.
        seeds: of the fits whose scores are averaged.
    """

    job: str
    data: Sequence[str]
    seconds: Mapping[str, int]
    steps: Mapping[str, int]
    seeds: Sequence[int] = (0, 1)


Benchmark = Compare | EqualSamples | Steps | Machine | Rates

NO_SCORES = ("--score-seconds", 0)
ABLATION = (
    "direct", "with-prior", "with-biased-prior", "with-stop-gradient", "with-second-bounce", "ours",
    "no-prior",
)  # fmt: skip
STEP_METHODS = (
    "ours", "direct", "no-prior", "ad-pt:neural:two-pass", "ad-pt:neural:split-halves",
    "prb:neural:two-pass", "prb:neural:all-pairs", "ours:bitmap", "prb:bitmap:two-pass",
    "prb:bitmap:all-pairs", "ours:grid", "prb:grid:two-pass", "prb:grid:all-pairs",
)  # fmt: skip
#: Whether PRB and AD-PT take two passes by default in rooms. The other estimator, the best one of
#: one pass otherwise, has rows of its own.
_TWO_PASSES = method_defaults.method_defaults("prb", "room").estimator == "two-pass"
RIVALS = (
    "ours",
    "prb",
    f"prb:neural:{'all-pairs' if _TWO_PASSES else 'two-pass'}",
    "ad-pt",
    f"ad-pt:neural:{'split-halves' if _TWO_PASSES else 'two-pass'}",
    "direct",
    "no-prior",
    "prb:bitmap",
)

#: By the name of the file of results; that of `machine` is named after the machine.
BENCHMARKS: dict[str, Benchmark] = {
    "machine": Machine(
        "machine",
        (
            ("ours", "demo", None, 100),
            ("ours:bitmap", "demo", None, 100),
            ("no-prior", "demo", None, 100),
            ("direct", "demo", None, 100),
            ("prb", "demo", None, 100),
            ("ours", STAIRCASE, None, 40),
        ),
    ),
    "methods-demo": Steps("steps", "demo", STEP_METHODS),
    # What `make demo` fits; and the true materials rendered alike, whose error is noise alone.
    "demo": Compare(
        "demo", "demo", ("ours", "direct"), steps=2400, seeds=(0,),
        options=(*NO_SCORES, "--evaluate-spp", 64, "--evaluate-truth"),
    ),
    # Equal time, and equal samples.
    "rivals-demo": Compare("rivals", "demo", RIVALS, seconds=60, seeds=SEEDS_AT_TIME),
    "equal-demo": EqualSamples("equal", ("ours", "no-prior", "direct"), "rivals-demo", "prb"),
    # What PRB has after 20 minutes; `rivals` shows when ours has it.
    "long-demo": Compare("long", "demo", ("prb",), seconds=1200, seeds=(0,)),
    "staircase": Compare(
        "staircase", STAIRCASE, ("ours", "prb", "direct"), seconds=120,
        options=("--evaluate-spp", 16),
    ),
    "ablation-materials": Compare("ablation", "demo", ABLATION, steps=2400, options=NO_SCORES),
    "ablation-lighting": Compare(
        "ablation", "still", ABLATION, steps=1200,
        options=(*NO_SCORES, "--unknown", "lighting"),
    ),
    # Materials and lighting, alone and together.
    **{
        f"still-{unknown}": Compare(
            "lighting", "still", ("ours",), steps=2400,
            options=(*NO_SCORES, "--unknown", unknown),
        )
        for unknown in ("materials", "lighting", "materials+lighting")
    },
    "emission": Compare(
        "emission", "demo", ("ours",), steps=2400, seeds=(0,),
        options=(*NO_SCORES, "--unknown", "emission"),
    ),
    # Six views, with and without regularization.
    **{
        f"sparse-{name}": Compare(
            "sparse", "few", ("ours",), steps=2400, options=NO_SCORES,
            settings=f"sparse/{name}.toml",
        )
        for name in ("none", "smooth", "tied", "both")
    },
    # What the prior gives where cameras see less: few views, half a room, a room behind a door.
    **{
        f"prior-{data}": Compare(
            "prior", data, ("ours", "no-prior"), steps=1200,
            # Few paths find the door of the annex: its renderings are noisy.
            options=(*NO_SCORES, "--evaluate-spp", 128 if data == "annex" else 32),
            groups=("seen", "unseen") if data in ("half", "annex") else (),
        )
        for data in ("demo", "few", "three", "half", "annex")
    },
    "rates": Rates(
        "rates", ("cornell", "small-still"), {"prb": 30},
        {"ours": 1600, "no-prior": 1600, "direct": 1600},
    ),
    # Whether what was found in the Cornell box serves another room.
    "rates-prb-own": Compare(
        "rates-check", "demo", ("prb",), seconds=60, seeds=SEEDS_AT_TIME, options=NO_SCORES,
        settings="rates/own.toml",
    ),
    "rates-own": Compare(
        "rates-check", "demo", ("ours", "no-prior"), steps=2400, options=NO_SCORES,
        settings="rates/own.toml",
    ),
    **{
        f"rates-{method}": Compare(
            "rates-check", "demo", (method,), steps=2400, options=NO_SCORES,
            settings=f"rates/{method}.toml",
        )
        for method in ("ours", "no-prior")
    },
}  # fmt: skip
JOBS = tuple(dict.fromkeys(benchmark.job for benchmark in BENCHMARKS.values()))


def at_smoke_scale(benchmark: Benchmark) -> Benchmark:
    """The same in seconds: two methods, few steps."""
    match benchmark:
        case EqualSamples():
            return replace(benchmark, methods=benchmark.methods[:1])
        case Machine():
            return replace(benchmark, cases=[(*case[:3], 10) for case in benchmark.cases[::5]])
        case Steps():
            return replace(benchmark, methods=benchmark.methods[:2])
        case Rates():
            steps = dict.fromkeys(benchmark.steps, 2)
            return replace(benchmark, seconds={}, steps=steps, seeds=benchmark.seeds[:1])
    return replace(
        benchmark,
        methods=benchmark.methods[:2],
        steps=4,
        seconds=0,
        seeds=benchmark.seeds[:2],
        options=(*benchmark.options, "--evaluate-spp", 2),
    )


# -------------------------------------------------------------------------------- How they are run


@dataclass(frozen=True)
class Bench:
    """Where the files of the benchmarks are, and how large they are.

    Args:
        out: folder of data sets, runs and records of jobs.
        results: folder of the files of results.
        staircase: data set of STAIRCASE; None leaves it out.
    """

    scale: str
    out: Path
    results: Path
    staircase: Path | None
    until: float | None = None
    console: Console = field(default_factory=lambda: Console(highlight=False))

    @property
    def work(self) -> Path:
        """The folder of a scale."""
        return self.out / self.scale

    def run(self, name: str, seed: int) -> Path:
        """The folder of a comparison's runs with a seed."""
        return self.work / "runs" / f"{name}-{seed}"

    def has(self, data: str) -> bool:
        """Whether a data set can be used."""
        return data != STAIRCASE or self.staircase is not None

    def data(self, name: str) -> Path:
        """The folder of a data set. Other settings have another one."""
        if name == STAIRCASE:
            assert self.staircase is not None
            return self.staircase
        # Data sets of before do not tell the light of their paths.
        captured = vars(self._capture(name)) | {"light_by_depth": [LIGHT_PIXELS, LIGHT_SAMPLES]}
        return self.work / "data" / digest(captured) / name

    def settings(self, name: str | None) -> tuple[list[object], str]:
        """Options that choose settings, and the text of their file."""
        if self.scale == "smoke":
            return ["--settings", self.work / "smoke.toml"], SMOKE
        if name is None:
            return [], ""
        file = ROOT / "benchmarks" / name
        return ["--settings", file], file.read_text(encoding="utf-8")

    def capture(self, name: str) -> list[Job]:
        """The job that renders a data set, if it is not a given one."""
        if name == STAIRCASE:
            return []
        shots, folder = self._capture(name), self.data(name)

        def work() -> Findings:
            if not folder.exists():
                sizes = ("--views", shots.views, "--held-out", shots.held_out)
                sizes += ("--resolution", shots.resolution, "--spp", shots.spp)
                if shots.cameras is not None:
                    sizes += ("--cameras", ROOT / "benchmarks" / shots.cameras)
                unbake("capture", shots.scene, "--out", folder, *sizes)
            return {}

        seconds = 5 + shots.samples / 600_000
        files = [DataFolder(folder).transforms_file]
        return [Job(f"data-{name}", vars(shots), work, seconds, files=files)]

    def _capture(self, name: str) -> Capture:
        if self.scale == "smoke":
            return Capture(DATA[name].scene, views=2, held_out=1, resolution=16, spp=4)
        return DATA[name]

    def command(
        self,
        name: str,
        words: Sequence[object],
        file: Path,
        data: str,
        settings: str | None,
        seconds: float | None,
        waits: float = 0.0,
    ) -> Job:
        """A job that is a command of `unbake` which writes a file."""
        options, text = self.settings(settings)
        command = partial(unbake, *words, *options, until=self.until)
        described = {"words": [str(word) for word in words], "settings": text}
        described |= {"data": str(self.data(data)), "defaults": method_defaults.as_json()}
        return Job(name, described, lambda: command() or {}, seconds, waits, [file])


@dataclass(frozen=True)
class Planned:
    """The jobs of a benchmark, and what is made of their files."""

    jobs: list[Job]
    write: Callable[[], Path]


def plan_machine(bench: Bench, benchmark: Machine) -> Planned:
    """Where the time of a step goes."""
    jobs, files = [], []
    for method, data, settings, steps in benchmark.cases:
        if not bench.has(data):
            print(f"STAIRCASE is not set: its {method} is left out", flush=True)
            continue
        label = f"step-{data}-{method.replace(':', '-')}"
        files.append(bench.work / "steps" / f"{label}.json")
        words = ["bench", "step", "--data", bench.data(data), "--method", method]
        words += ["--steps", steps, "--out", files[-1]]
        jobs += bench.capture(data)
        jobs.append(bench.command(label, words, files[-1], data, settings, 25.0))

    def write() -> Path:
        name, result = machine_results(files)
        write_json(bench.results / f"{name}.json", result)
        return bench.results / f"{name}.json"

    return Planned(jobs, write)


def plan_steps(bench: Bench, name: str, benchmark: Steps) -> Planned:
    """Step times of methods, side by side."""
    file = bench.work / "steps" / f"{name}.json"
    words = ["bench", "methods", "--data", bench.data(benchmark.data)]
    words += ["--methods", *benchmark.methods, "--steps", steps_of(bench), "--out", file]
    job = bench.command(
        name, words, file, benchmark.data, benchmark.settings, 25.0 * len(benchmark.methods)
    )

    def write() -> Path:
        write_json(bench.results / f"{name}.json", read(file))
        return bench.results / f"{name}.json"

    return Planned([*bench.capture(benchmark.data), job], write)


#: Fits of a search with one seed, about; seconds of each beside the fit itself, and of a step.
TRIALS, SCORING, STEP = 12, 6.0, 0.008


def plan_rates(bench: Bench, name: str, benchmark: Rates) -> Planned:
    """Searches for learning rates, a job for each method; they share the file that is their record.

    The file keeps what was fitted when a job is stopped. With other settings there is another one.
    """
    options, text = bench.settings(None)
    folders = [bench.data(data) for data in benchmark.data]
    described = {"settings": text, "data": [str(folder) for folder in folders]}
    described |= {"seconds": benchmark.seconds, "steps": benchmark.steps, "schedule": True}
    file = bench.work / "rates" / digest(described) / f"{name}.json"
    jobs = [job for data in benchmark.data for job in bench.capture(data)]
    fits = TRIALS * len(folders) * len(benchmark.seeds)
    lengths = [(method, "--seconds", n) for method, n in benchmark.seconds.items()]
    lengths += [(method, "--steps", n) for method, n in benchmark.steps.items()]
    for method, option, length in lengths:
        words = ["bench", "rates", "--data", *folders, "--methods", method, option, length]
        words += [*options, "--seeds", *benchmark.seeds, "--schedule", "--out", file]
        # Defaults of methods are what is searched: no search depends on them.
        settings = described | {"method": method, "seeds": list(benchmark.seeds)}
        command = partial(unbake, *words, until=bench.until)
        jobs.append(
            Job(
                f"{name}-{method}",
                settings,
                lambda command=command: command() or {},
                (SCORING + STEP * length * (option == "--steps")) * fits,
                length * fits * (option == "--seconds"),
                [file],
            )
        )

    def write() -> Path:
        write_json(bench.results / f"{name}.json", read(file))
        return bench.results / f"{name}.json"

    return Planned(jobs, write)


def steps_of(bench: Bench) -> int:
    """Steps to take the median of."""
    return 10 if bench.scale == "smoke" else 100


def plan_compare(bench: Bench, name: str, benchmark: Compare) -> Planned:
    """Fits of methods, a job for each seed."""
    folders = [bench.run(name, seed) for seed in benchmark.seeds]
    length = ["--seconds", benchmark.seconds] if benchmark.seconds else ["--steps", benchmark.steps]
    jobs = bench.capture(benchmark.data)
    if benchmark.seconds:
        jobs.append(compiled(bench, name, benchmark))
    for seed, folder in zip(benchmark.seeds, folders, strict=True):
        words = ["compare", bench.data(benchmark.data), "--methods", *benchmark.methods]
        words += [*length, *benchmark.options, "--seed", seed, "--out", folder]
        jobs.append(
            bench.command(
                folder.name,
                words,
                folder / "compare.json",
                benchmark.data,
                benchmark.settings,
                fit_seconds(bench, name, benchmark),
                benchmark.seconds * len(benchmark.methods),
            )
        )

    def write() -> Path:
        write_json(bench.results / f"{name}.json", summary(folders, benchmark.groups))
        return bench.results / f"{name}.json"

    return Planned(jobs, write)


def compiled(bench: Bench, name: str, benchmark: Compare) -> Job:
    """A job that takes a few steps of every method, which leaves their kernels in Dr.Jit's cache.

    The time of a fit has the compilation of kernels in it that are not there. It is longest for
    methods that follow whole paths, and the first seed would pay for all.
    """
    file = bench.work / "steps" / f"compiled-{name}.json"
    words = ["bench", "methods", "--data", bench.data(benchmark.data)]
    words += ["--methods", *benchmark.methods, "--steps", 10, "--out", file]
    seconds = 12.0 * len(benchmark.methods)
    return bench.command(file.stem, words, file, benchmark.data, benchmark.settings, seconds)


def plan_equal(bench: Bench, name: str, benchmark: EqualSamples) -> Planned:
    """Fits with the samples of a slower method, after those at equal time that it needs."""
    at_time = BENCHMARKS[benchmark.like]
    if bench.scale == "smoke":
        at_time = at_smoke_scale(at_time)
    assert isinstance(at_time, Compare)
    timed = plan_compare(bench, benchmark.like, at_time)
    pairs = [(bench.run(benchmark.like, seed), bench.run(name, seed)) for seed in at_time.seeds]
    jobs = list(timed.jobs)
    for seed, (slow, folder) in zip(at_time.seeds, pairs, strict=True):
        # Searches of roughness would be samples that other methods do not have.
        options, text = bench.settings("search/steps.toml")
        words = ["compare", bench.data(at_time.data), "--methods", *benchmark.methods, *options]
        words += [*NO_SCORES, *at_time.options, "--seed", seed, "--out", folder]

        def work(slow: Path = slow, words: Sequence[object] = words, text: str = text) -> Findings:
            if not (slow / "compare.json").is_file():
                raise Unfinished
            steps = steps_of_equal_samples(read(slow / "compare.json"), benchmark, text)
            unbake(*words, "--steps", steps, until=bench.until)
            return {"steps": steps}

        settings = {"words": [str(word) for word in words], "settings": text}
        settings |= {"like": benchmark.like, "slow": benchmark.slow}
        settings["defaults"] = method_defaults.as_json()
        # They are quicker than the slow method, by a factor that depends on the machine.
        seconds = (OVERHEAD + at_time.seconds / 3) * len(benchmark.methods)
        jobs.append(Job(folder.name, settings, work, seconds, files=[folder / "compare.json"]))

    def write() -> Path:
        both = [[read(folder / "compare.json") for folder in pair] for pair in pairs]
        merged = [with_slow(slow, equal, benchmark.slow) for slow, equal in both]
        write_json(bench.results / f"{name}.json", summarized(merged))
        return bench.results / f"{name}.json"

    return Planned(jobs, write)


def steps_of_equal_samples(at_time: dict[str, Any], benchmark: EqualSamples, settings: str) -> int:
    """Steps of the quick methods with the camera samples of the slow one, to the nearest step.

    Args:
        at_time: content of `compare.json`, which has the slow one.
        settings: of the quick ones, TOML.

    Raises:
        UserError: the slow method failed.
        ValueError: the quick methods trace different numbers of samples in a step.
    """
    slow = at_time["methods"][benchmark.slow]
    if "error" in slow:
        raise UserError(f"{benchmark.slow} failed: {slow['error']}", benchmark.like)
    config = from_toml(settings)
    each = {with_method(config, method).samples_per_step for method in benchmark.methods}
    if len(each) > 1:
        raise ValueError(f"steps of {each} samples cannot have the same length")
    return round(slow["samples"] / each.pop())


def with_slow(at_time: dict[str, Any], equal: dict[str, Any], slow: str) -> dict[str, Any]:
    """The comparison at equal samples, with the fit of the slow method at equal time."""
    return equal | {"methods": equal["methods"] | {slow: at_time["methods"][slow]}}


#: Computing time beside the fit: compiling, scores and the final renderings.
OVERHEAD = 25.0


def fit_seconds(bench: Bench, name: str, benchmark: Compare) -> float | None:
    """Computing time of a comparison, from the committed results of the reference machine."""
    if bench.scale == "smoke":
        return 5.0 * len(benchmark.methods)
    other = OVERHEAD * len(benchmark.methods)
    if benchmark.seconds:
        return other
    file = RESULTS / f"{name}.json"
    if not file.is_file():
        return None
    rows: dict[str, Any] = read(file)["methods"]
    known = [row["seconds"] for row in rows.values() if "seconds" in row]
    return other + statistics.fmean(known) * len(benchmark.methods)


def planned(bench: Bench, names: Sequence[str]) -> list[Planned]:
    """The benchmarks of jobs, in the order in which the jobs are named."""
    plans = []
    for job in names:
        for name, benchmark in BENCHMARKS.items():
            if benchmark.job != job:
                continue
            if bench.scale == "smoke":
                benchmark = at_smoke_scale(benchmark)
            match benchmark:
                case Machine():
                    plans.append(plan_machine(bench, benchmark))
                case EqualSamples():
                    plans.append(plan_equal(bench, name, benchmark))
                case Rates():
                    plans.append(plan_rates(bench, name, benchmark))
                case _ if not bench.has(benchmark.data):
                    print(f"STAIRCASE is not set: {name} is left out", flush=True)
                case Steps():
                    plans.append(plan_steps(bench, name, benchmark))
                case Compare():
                    plans.append(plan_compare(bench, name, benchmark))
    return plans


def slowness() -> float:
    """Time that computing takes here, relative to the machine of the estimates."""
    from unbake import activate

    activate()
    from unbake.experiments import speed

    return speed.slowness()


def run() -> int:
    """Run the jobs that are named on the command line, and write results."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    staircase = os.environ.get("STAIRCASE") or None
    parser.add_argument("jobs", metavar="JOB", nargs="*", help=f"of: {' '.join(JOBS)}")
    parser.add_argument("--scale", choices=("smoke", "cpu"), default="cpu", help="smoke: seconds")
    parser.add_argument("--out", type=Path, default=ROOT / "build" / "bench")
    parser.add_argument("--results", type=Path, help="default: benchmarks/results; smoke: in --out")
    parser.add_argument("--staircase", type=Path, default=staircase, help="its data set")
    call_settings(parser)
    args = parser.parse_args()
    unknown = [job for job in args.jobs if job not in JOBS]
    if unknown:
        raise UserError(f"no job named {unknown[0]!r}", remedy=f"There are {', '.join(JOBS)}")
    # Numbers at smoke scale mean nothing: they must not replace the committed ones.
    own = args.out / "smoke" / "results" if args.scale == "smoke" else RESULTS
    until = end_of_call(args)
    bench = Bench(args.scale, args.out, args.results or own, args.staircase, until)
    plans = planned(bench, args.jobs or JOBS)
    jobs = {job.name: job for plan in plans for job in plan.jobs}
    runner = JobRunner(bench.work / "jobs", bench.console, slowness=slowness)
    if args.scale == "smoke" and not args.plan:
        file = bench.work / "smoke.toml"
        write_atomically(file, lambda path: path.write_text(SMOKE, encoding="utf-8"))
    outcome = run_jobs(runner, list(jobs.values()), args, until)
    if outcome is None:
        return 0
    for plan in plans:
        # A comparison with a method that failed has the numbers of the others.
        if all(job.name not in outcome.left and _written(job) for job in plan.jobs):
            print(f"wrote {plan.write()}", flush=True)
    return 1 if outcome.failed else 0


def _written(job: Job) -> bool:
    return all(file.is_file() for file in job.files)


if __name__ == "__main__":
    main(run)
