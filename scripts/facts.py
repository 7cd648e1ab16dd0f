"""Measured numbers for the templates of pages: committed results, and how they are printed.

Results are `benchmarks/results/NAME.json`, and `docs/reproduction/NAME/` for the paper's tables and
figures. A number that is not there ends the writing of pages with the command that makes it.
"""

from __future__ import annotations

import csv
import math
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))
sys.path.append(str(ROOT / "tests"))

import tables as benchmark_tables  # noqa: E402
from summary import phases_of, read, roofline_of  # noqa: E402

from unbake.comparison.rate_search import STEP  # noqa: E402
from unbake.config import PAPER_DEPTH  # noqa: E402
from unbake.evaluation.convergence import WINDOW  # noqa: E402
from unbake.experiments.seeds import plus_minus  # noqa: E402
from unbake.experiments.tables import markdown  # noqa: E402
from unbake.imaging.metrics import HIGHEST  # noqa: E402
from unbake.machine import same_machine  # noqa: E402

Row = dict[str, Any]

TAKE_OVER = "python scripts/write_docs.py --results reproduction --scenes scenes"
VERSION_0_1 = """made with version 0.1, where PRB and AD-PT had the learning rates that were found
for ours and their warm-up, and paths of 15 interactions at most (no Russian roulette for AD-PT);
one seed."""
OURS_OF_0_1 = "made with version 0.1, without the untrained fields."
STEPS_OF_0_1 = """step times of version 0.1, where PRB and AD-PT followed paths of 15 interactions
at most, AD-PT without Russian roulette."""
NOT_SEARCHED = """The search has not been run yet (`unbake bench rates`): all methods have the rates
of the fields, which were found for ours."""
#: What a template may call a number, where it has another key in a file of results.
KEYS = {"albedo": "albedo_psnr", "roughness": "roughness_psnr", "rendering": "render_psnr"}
#: Of materials, of which a row is the better the higher their mean is.
MAPS = ("albedo_psnr", "roughness_psnr")
_NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)(e[+-]?\d+)?", re.IGNORECASE)


class Unfounded(Exception):
    """A page asks for a number that no committed result has."""


class Facts:
    """Committed results, as templates ask for them.

    Args:
        results: folder of the benchmarks' results.
        kept: folder of the paper's tables and figures.
    """

    def __init__(self, results: Path, kept: Path) -> None:
        self.results, self.kept = results, kept
        self.result: Callable[[str], Row] = cache(self._result)
        self.rows: Callable[[str], list[Row]] = cache(self._rows)

    # ------------------------------------------------------------------------------- Benchmarks

    def _result(self, name: str) -> Row:
        file = self.results / f"{name}.json"
        if not file.is_file():
            raise Unfounded(f"{file} is missing. `{made_by(name)}` makes it")
        return read(file)

    def has(self, *names: str) -> bool:
        """Whether all of these results are committed."""
        return all((self.results / f"{name}.json").is_file() for name in names)

    def table(self, title: str) -> str:
        """A table of `benchmarks/tables.py`, by its title there."""
        known = {known: (names, make) for known, names, make in benchmark_tables.TABLES}
        if title not in known:
            raise Unfounded(f"no table is called {title!r}. There are: {'; '.join(known)}")
        names, make = known[title]
        return make(*map(self.result, names))

    def method(self, name: str, method: str) -> Row:
        """The numbers of a method in a comparison."""
        methods = self.result(name)["methods"]
        row = part(methods, method, f"{name}.json")
        if "error" in row:
            raise Unfounded(f"{name}.json: {method} failed: {row['error']}")
        return row

    def of(self, name: str, method: str, key: str) -> float:
        """A number of a method in a comparison: `of("rivals-demo", "ours", "albedo")`."""
        row = self.method(name, method)
        return part(row, KEYS.get(key, key), f"{name}.json, {method}")

    def db(self, name: str, method: str, key: str, digits: int = 1) -> str:
        """A PSNR in dB; with its standard deviation if there are several seeds."""
        self.of(name, method, key)
        return f"{plus_minus(self.method(name, method), KEYS.get(key, key), digits)} dB"

    def halfway(self, name: str, method: str, key: str) -> tuple[float, float]:
        """Scores during training, mean over seeds: at half of the time, and at the end."""
        key, found = KEYS.get(key, key), []
        for run in self.of(name, method, "per_seed"):
            curve = part(run, "score", f"{name}.json, {method}")
            times, scores = zip(*((row["seconds"], row[key]) for row in curve), strict=True)
            found.append((float(np.interp(times[-1] / 2, times, scores)), scores[-1]))
        middles, ends = zip(*found, strict=True)
        return sum(middles) / len(middles), sum(ends) / len(ends)

    def gap(self, name: str, a: str, b: str, key: str, other: str | None = None) -> str:
        """How far a is above b: `+2.4 dB`, `−0.3 dB` or `level`.

        They are level where the printed difference is zero, or where it is within the standard
        deviation of the difference of two fits over seeds.

        Args:
            name: the comparison that holds a.
            a: a method.
            b: a method.
            key: what is compared.
            other: the comparison that holds b, if it is another one.
        """
        key = KEYS.get(key, key)
        first, second = self.method(name, a), self.method(other or name, b)
        difference = self.of(name, a, key) - self.of(other or name, b, key)
        spread = math.hypot(*(row.get(f"{key}_sd") or 0.0 for row in (first, second)))
        return above(difference, spread)

    def versus(self, name: str) -> str:
        """How far ours is above each rival of a comparison, as a table."""
        rivals = [rival for rival in self.known(name) if rival not in ("ours", "untrained")]
        rows = [
            [f"`{rival}`", *(self.gap(name, "ours", rival, q) for q in KEYS)] for rival in rivals
        ]
        return markdown(["`ours` against", *KEYS], rows)

    def known(self, name: str) -> dict[str, Row]:
        """The rows of a comparison that did not fail, after that of the untrained fields."""
        rows = benchmark_tables.methods_of(self.result(name))
        return {run: row for run, row in rows if "error" not in row}

    def seeds(self, name: str) -> str:
        """How many seeds a comparison is of, in words."""
        count = len(self.result(name)["seeds"])
        return "one seed" if count == 1 else f"{count} seeds"

    def step(self, name: str, method: str, materials: str = "neural", spp: str = "") -> Row:
        """A row of `unbake bench methods`, the first that fits."""
        for row in self.result(name)["rows"]:
            asked = {"method": method, "representation": materials, "estimator": spp}
            if all(value in ("", row[key]) for key, value in asked.items()):
                return row
        raise Unfounded(f"{name}.json has no {method} with {materials} materials {spp}")

    def step_ratio(self, name: str, method: str, materials: str = "neural", spp: str = "") -> float:
        """Time of a step as a multiple of that of ours with the same materials."""
        return benchmark_tables.ratio(self.step(name, method, materials, spp), self.result(name))

    def in_time(self, settings: str | None = None) -> list[Row]:
        """Ours beside PRB after the same training time, a row a scene, by `benchmarks/variants.py`.

        Rows have `data`, `seconds` and `seeds`, the row of each method by its name, their
        `yardsticks`, and `how` they were made: the processor, and what has changed since. Of a
        method with several settings it is the row with the best mean of albedo and roughness, or
        that of the settings that are asked for.
        """
        rows = []
        for name in ("demo-in-time", "rooms", "objects", "lego-plant"):
            found = self.result(name) if self.has(name) else {"rows": []}
            by_scene: dict[str, Row] = {}
            on = f"on an {found['machine']['processor']}" if found["rows"] else ""
            asked = [row for row in found["rows"] if settings in (None, row["settings"])]
            for row in sorted(asked, key=lambda row: sum(row[key] for key in MAPS)):
                by_scene.setdefault(row["data"], {})[row["method"]] = row
            by_scene = {name: by_scene[name] for name in found.get("data", ())}
            rows += [
                {
                    "data": data,
                    "seconds": found["length"]["seconds"],
                    "seeds": len(found["seeds"]),
                    "how": ", ".join(filter(None, (on, found.get("note")))),
                    "yardsticks": self.yardsticks(found, methods["ours"]),
                }
                | methods
                for data, methods in by_scene.items()
            ]
        return rows

    def yardsticks(self, found: Row, row: Row) -> dict[str, Row]:
        """What the scores of a fit by `benchmarks/variants.py` are to be measured by.

        Args:
            found: the result.
            row: a row of it.

        Returns:
            `untrained`, `constant` and `ceiling`, as far as they are known: PSNRs in dB by key.
            Ceilings are those of the same views.
        """
        views = found["data"][row["data"]]
        asked = (row["data"], views["train"], views["heldout"])
        ceilings = self.result("ceilings")["rows"] if self.has("ceilings") else []
        told: Row = {}
        for other in ceilings:
            if (other["data"], other["train_views"], other["heldout_views"]) == asked:
                told = other
        told = told | row
        kinds = {}
        for kind in ("untrained", "constant", "ceiling"):
            scores = {key: told.get(f"{kind}_{key}") for key in MAPS}
            if any(score is not None for score in scores.values()):
                kinds[kind] = scores
        return kinds

    def of_one_value(self, quantity: str) -> list[str]:
        """The scenes of `in_time` whose true map is one value, which a constant meets."""
        constants = {row["data"]: self._constant(row, KEYS[quantity]) for row in self.in_time()}
        return [f"`{data}`" for data, score in constants.items() if score and score >= HIGHEST]

    def below(self, method: str, kind: str, settings: str | None = None) -> list[str]:
        """Where a method of `in_time` scores less than a yardstick, in words.

        Scenes that one value describes without error are left out.

        Args:
            method: its better row, where there are several.
            kind: `constant`, or `untrained`, the fields before the first step.
            settings: the row of these instead.
        """
        rows = self.in_time(settings)
        return lower((row["data"], row[method], row["yardsticks"].get(kind, {})) for row in rows)

    def below_in(self, found: Row, method: str, kind: str) -> list[str]:
        """Where a method does so in one result by `benchmarks/variants.py`."""
        rows = [row for row in found["rows"] if row["method"] == method]
        return lower((row["data"], row, self.yardsticks(found, row).get(kind, {})) for row in rows)

    def ahead_of_ours(self, found: Row, rival: str) -> dict[str, list[str]]:
        """Where a rival is ahead in a result by `benchmarks/variants.py`, as one digit shows it.

        Returns:
            By what is compared, where there is any: scenes with the scores of both.
        """
        by_name = {(row["data"], row["method"]): row for row in found["rows"]}
        told: dict[str, list[str]] = {}
        for word, key in KEYS.items():
            for data in found["data"]:
                other, ours = by_name[data, rival][key], by_name[data, "ours"][key]
                if round(other, 1) > round(ours, 1):
                    scores = f"{other:.1f} dB against {ours:.1f} dB"
                    told.setdefault(word, []).append(f"`{data}` ({scores})")
        return told

    @staticmethod
    def _constant(row: Row, key: str) -> float | None:
        return row["yardsticks"].get("constant", {}).get(key)

    def behind_in_time(self) -> list[str]:
        """Where PRB is ahead of ours in `in_time` by more than seeds differ, in words."""
        told = []
        for word, key in KEYS.items():
            for row in self.in_time():
                ours, prb = row["ours"], row["prb"]
                spread = math.hypot(*(x.get(f"{key}_sd") or 0.0 for x in (ours, prb)))
                difference = above(ours[key] - prb[key], spread)
                if difference.startswith("−"):
                    told.append(f"{word} of `{row['data']}` ({difference})")
        return told

    def older(self, *names: str) -> str:
        """A warning where results were made before every method had settings of its own.

        Comparisons of version 0.1 hold no numbers of single seeds, its step times no depth of
        paths, and its steps by phase call the phases parts.
        """
        told = []
        for words, old in (
            (VERSION_0_1, _old_rivals),
            (OURS_OF_0_1, lambda result: _old_fits(result) and not _old_rivals(result)),
            (STEPS_OF_0_1, _old_steps),
        ):
            files = ", ".join(f"`{name}.json`" for name in names if old(self.result(name)))
            told += [f"{files}: {words}"] if files else []
        again = " They are to be made anew." if told else ""
        return f"> **Older results.** {' '.join(told)}{again}\n" if told else ""

    def searched(self, method: str) -> bool:
        """Whether the learning rates of a method were searched."""
        searches = self.result("rates")["searches"] if self.has("rates") else []
        return any(search["method"] == method for search in searches)

    def schedules(self) -> str:
        """What searches found of warm-up and decay, as sentences; empty where they did not look."""
        searches = self.result("rates")["searches"] if self.has("rates") else []
        looked = [search for search in searches if "warm_up" in search["trials"][0]]
        told = []
        for search in looked:
            key, own = "final_learning_rate", search["trials"][0]
            found = (search["best"] or own)[key]
            if found != own[key]:
                told.append(
                    f"In {search['kind']}s the rates of `{search['method']}` fall to {found:.2g} "
                    f"of their start instead of {own[key]:.2g}."
                )
        names = list(dict.fromkeys(search["method"] for search in searches))
        missed = [f"`{n}`" for n in names if n not in {search["method"] for search in looked}]
        if looked and missed:
            told.append(f"For {', '.join(missed)} neither was searched yet.")
        return " ".join(["", *told])

    def search_gain(self, method: str, kind: str) -> str:
        """What a search found better than the fields' own rates, in dB."""
        for search in self.result("rates")["searches"]:
            if (search["method"], search["kind"]) == (method, kind):
                return above(search["best"]["score"] - search["trials"][0]["score"])
        raise Unfounded(f"rates.json has no search of {method} in {kind}s")

    def rates_table(self) -> str:
        """What is taken of searches for learning rates; that there was none, without a file."""
        if not self.has("rates"):
            return NOT_SEARCHED
        rows = []
        for search in self.result("rates")["searches"]:
            best = part(search, "best", f"rates.json, {search['method']}")
            factors = ", ".join(f"{name} x {by:g}" for name, by in best["factors"].items())
            chosen = best["estimator"].replace("-", " ") if search["follows_paths"] else ""
            scene = f"{search['kind']}s", search["unknown"], search["data"]
            fits = sum(len(trial["per_seed"]) for trial in search["trials"])
            own = search["trials"][0]  # a search begins with the fields' rates
            scores = [f"{row['score']:.1f}" for row in (search["untrained"], own, best)]
            schedule = [_told(best.get(key)) for key in ("final_learning_rate", "warm_up")]
            row = [f"`{search['method']}`", *scene, factors, *schedule, chosen, *scores, fits]
            rows.append(row)
        titles = [
            "method",
            "for",
            "unknown",
            "found on",
            "factors of the rates",
            "fall to",
            "warm-up",
            "estimator",
            "untrained",
            "own rates",
            "taken",
            "fits",
        ]
        return markdown(titles, rows)

    def phases(self, name: str) -> str:
        """Where the time of the steps of a machine goes, as a table."""
        return benchmark_tables.phases(self.result(name))

    def untried_commands(self) -> list[str]:
        """The commands that got no signal in the campaign of `benchmarks/signals.py`, as code."""
        from unbake.cli import COMMANDS

        tried = {name.split()[0] for name in self.result("signals")["ends"]}
        names = dict.fromkeys(name.split()[0] for name in COMMANDS)
        return [f"`{name}`" for name in names if name not in tried]

    def untried_formats(self) -> list[str]:
        """The formats that `benchmarks/fuzz.py` has, and had not when its result was made."""
        from fuzzing.formats import FORMATS

        return [name for name in FORMATS if name not in self.result("fuzz")["formats"]]

    def phase_sums(self, name: str) -> list[float]:
        """The phases of each step of a machine together, over the whole step; the least first."""
        return sorted(
            sum(phase["milliseconds"] for phase in phases_of(step).values())
            / step["milliseconds_per_step"]
            for step in self.result(name)["steps"]
        )

    def machine_file(self) -> str:
        """The name of the file of `unbake bench step` on the machine of the comparisons."""
        machine = self.result("rivals-demo")["machine"]
        for file in sorted(self.results.glob("*.json")):
            result = self.result(file.stem)
            if isinstance(result.get("steps"), list) and same_machine(result["machine"], machine):
                return file.stem
        raise Unfounded(f"{self.results}: no steps of {machine}. `{made_by('machine')}` makes them")

    def machine_step(self, name: str, method: str, demo: bool = True) -> Row:
        """A step of a machine's file on the demo or on STAIRCASE, whatever the file's version."""
        for step in self.result(name)["steps"]:
            if step["method"] == method and (step["data"] == "demo") == demo:
                return step | {"phases": phases_of(step), "roofline": roofline_of(step)}
        scene = "the demo" if demo else "STAIRCASE"
        raise Unfounded(f"{name}.json has no step of {method} on {scene}. `{made_by('machine')}`")

    def machine(self, *names: str) -> str:
        """The one machine that all of these results are of, in words."""
        found = {name: self.result(name)["machine"] for name in names}
        return machine_words(found)

    # ------------------------------------------------------------ The paper's tables and figures

    def about(self, experiment: str) -> Row:
        """What is known of a run of `unbake reproduce`."""
        return read(self._kept(experiment, "about.json"))

    def _kept(self, experiment: str, name: str) -> Path:
        file = self.kept / experiment / name
        if not file.is_file():
            make = f"unbake reproduce {experiment} --out reproduction"
            raise Unfounded(f"{file} is missing. `{make}`, then `{TAKE_OVER}` make it")
        return file

    def _rows(self, experiment: str) -> list[Row]:
        with open(self._kept(experiment, "data.csv"), encoding="utf-8", newline="") as file:
            return [{k: number_or_text(v) for k, v in row.items()} for row in csv.DictReader(file)]

    def where(self, experiment: str, **values: object) -> Row:
        """The first record of an experiment's data with these values."""
        for row in self.rows(experiment):
            if all(row.get(key) == value for key, value in values.items()):
                return row
        raise Unfounded(f"{self.kept / experiment / 'data.csv'}: no row with {values}")

    def fastest(self, experiment: str, *methods: str, **values: object) -> Row:
        """Of the records of these methods with these values, the one of the shortest step."""
        rows = [
            row
            for row in self.rows(experiment)
            if row["method"] in methods
            and isinstance(row["milliseconds"], int | float)
            and all(row.get(key) == value for key, value in values.items())
        ]
        if not rows:
            place = self.kept / experiment / "data.csv"
            raise Unfounded(f"{place}: no time of {' or '.join(methods)} with {values}")
        return min(rows, key=lambda row: row["milliseconds"])

    def experiment_table(self, experiment: str) -> str:
        """The table that an experiment wrote."""
        return self._kept(experiment, "table.md").read_text(encoding="utf-8").strip()

    def cost(self, experiment: str) -> str:
        """The time that an experiment took, in words."""
        seconds = self.about(experiment)["seconds"]
        return f"{seconds / 60:.0f} minutes" if seconds >= 90 else f"{seconds:.0f} seconds"

    def picture(self, experiment: str, file: str, words: str) -> str:
        """A picture of an experiment, as Markdown on a page of docs/."""
        self._kept(experiment, f"{file}.jpg")
        return f"![{words}]({self.kept.name}/{experiment}/{file}.jpg)"

    def state(self, experiment: str) -> str:
        """A warning where an experiment was run with an older state of the code."""
        older = self.about(experiment).get("made_with")
        return "" if older is None else f"> **Older results.** {older}\n"

    def by_scene(self, experiment: str) -> list[str]:
        """The scenes of an experiment, in its order."""
        return list(dict.fromkeys(row["scene"] for row in self.rows(experiment)))

    def methods_in(self, experiment: str) -> list[str]:
        """The methods of an experiment, in its order."""
        return list(dict.fromkeys(row["method"] for row in self.rows(experiment)))

    def ahead(self, experiment: str, key: str, a: Row, b: Row) -> str:
        """How far the record with the values a is above the one with the values b, as `gap`."""
        first, second = self.where(experiment, **a), self.where(experiment, **b)
        spread = math.hypot(*(row.get(f"{key}_sd") or 0.0 for row in (first, second)))
        return above(first[key] - second[key], spread)

    def wins(self, experiment: str, key: str, a: str, b: str) -> int:
        """The number of scenes where method a is above b, and not level."""
        pairs = [
            ({"scene": scene, "method": a}, {"scene": scene, "method": b})
            for scene in self.by_scene(experiment)
        ]
        return sum(self.ahead(experiment, key, *pair).startswith("+") for pair in pairs)

    def below_untrained(self, experiment: str, method: str) -> list[str]:
        """Where a method scores less than the untrained fields of its scene, in words."""
        told = []
        for word, key in KEYS.items():
            for scene in self.by_scene(experiment):
                start = self.where(experiment, scene=scene, method="untrained")[key]
                end = self.where(experiment, scene=scene, method=method)[key]
                if end < start:
                    told.append(f"{word} of {scene} ({end:.1f} dB against {start:.1f} dB)")
        return told

    def published_is_smaller(self, experiment: str, method: str) -> list[bool]:
        """Of each published scene, whether a method's multiple of ours is smaller there."""
        rows = [row for row in self.rows(experiment) if row["method"] == method]
        pairs = [(row.get("published_times_ours"), row["times_ours"]) for row in rows]
        return [published < own for published, own in pairs if published is not None]

    def fastest_by_scene(self, experiment: str, *methods: str) -> list[Row]:
        """`fastest` of these methods in each scene, those that are nearest to ours first."""
        found = [self.fastest(experiment, *methods, scene=s) for s in self.by_scene(experiment)]
        return sorted(found, key=lambda row: row["times_ours"])

    def as_fast_as_ours(self, experiment: str) -> list[Row]:
        """The records of methods that follow paths, and whose step takes no longer than ours."""
        return [
            row
            for row in self.rows(experiment)
            if row["method"].startswith(("PRB", "AD-PT")) and round(row["times_ours"], 2) <= 1
        ]

    def experiments_machine(self) -> str:
        """What the machines of all experiments have in common, in words: not their processors."""
        found = {
            f"{file.parent.name}-{i}": machine
            for file in sorted(self.kept.glob("*/about.json"))
            for i, machine in enumerate(self.about(file.parent.name)["machines"])
        }
        require_same(found, ("cores", "variant", "mitsuba"))
        machine = next(iter(found.values()))
        return f"{cores_of(machine)}, `{machine['variant']}`, Mitsuba {machine['mitsuba']}"

    def processors(self, experiment: str) -> str:
        """The processors that an experiment ran on."""
        machines = self.about(experiment)["machines"]
        return ", ".join(dict.fromkeys(machine["processor"] for machine in machines))


# ---------------------------------------------------------------------------- How they are printed


def part(row: Mapping[str, Any], key: str, where: str) -> Any:
    """A key of a result, or an error that says which there are."""
    if row.get(key) is None:
        raise Unfounded(f"{where} has no {key!r}. It has: {', '.join(map(str, row))}")
    return row[key]


def lower(rows: Iterable[tuple[str, Row, Row]]) -> list[str]:
    """Where scores of scenes are lower than others, in words: those of one value are left out."""
    told = list(rows)
    return [
        f"{word} of `{data}`"
        for word, key in (("albedo", "albedo_psnr"), ("roughness", "roughness_psnr"))
        for data, scores, least in told
        if least.get(key) is not None and scores[key] < least[key] < HIGHEST
    ]


def _old_fits(result: Row) -> bool:
    """Whether a comparison is of version 0.1."""
    rows = result.get("methods", {})
    return any("per_seed" not in row and "error" not in row for row in rows.values())


def _old_rivals(result: Row) -> bool:
    """The same with methods that follow paths."""
    return _old_fits(result) and any(map(_follows_paths, result["methods"]))


def _follows_paths(name: str) -> bool:
    """Whether a run of a comparison is of PRB or AD-PT, by its name."""
    return name.startswith(("prb", "ad-pt"))


def _old_steps(result: Row) -> bool:
    """Whether step times, of several methods or of a machine, are of version 0.1."""
    if "unbake" in result:
        return False
    followed = (row for row in result.get("rows", ()) if row["method"] in ("prb", "ad-pt"))
    steps = result["steps"] if isinstance(result.get("steps"), list) else []
    return any(row.get("path_depth") is None for row in followed) or any(
        "unbake" not in step and "phases" not in step for step in steps
    )


def made_by(name: str) -> str:
    """The command that makes a file of results."""
    import run

    benchmark = run.BENCHMARKS.get(name)
    if benchmark is not None:
        return f"python benchmarks/run.py {benchmark.job}"
    script = f"benchmarks/{name.replace('-', '_')}.py"
    if (ROOT / script).is_file():
        return f"python {script}"
    return f"git log --all -- benchmarks/results/{name}.json"


def machine_words(found: Mapping[str, Row]) -> str:
    """A machine in words, the same for all results."""
    require_same(found, ("processor", "cores", "variant", "mitsuba"))
    first = next(iter(found.values()))
    software = f"`{first['variant']}`, Mitsuba {first['mitsuba']}"
    return f"{cores_of(first)} of an {first['processor']}, {software}"


def require_same(found: Mapping[str, Row], keys: Sequence[str]) -> None:
    """Refuse machines that differ in one of these keys."""
    first_name, first = next(iter(found.items()))
    for name, machine in found.items():
        if any(machine[key] != first[key] for key in keys):
            raise Unfounded(f"a page mixes machines: {first_name}: {first}; {name}: {machine}")


def cores_of(machine: Row) -> str:
    """The number of cores of a machine, in words."""
    return {1: "one core", 2: "two cores"}.get(machine["cores"], f"{machine['cores']} cores")


def _told(value: float | None) -> str:
    """A number that was searched for; empty where it was not."""
    return "" if value is None else f"{value:.3g}"


def number_or_text(text: str) -> float | str | None:
    """A cell of a table: a number where it is one, None where it is empty."""
    if not text:
        return None
    return float(text) if _NUMBER.fullmatch(text) else text


def above(difference: float, spread: float = 0.0, digits: int = 1) -> str:
    """A difference of PSNRs: `+2.4 dB`, `−0.3 dB` or `level`."""
    shown = f"{abs(difference):.{digits}f}"
    if float(shown) == 0 or abs(difference) < spread:
        return "level"
    return f"{'+' if difference > 0 else '−'}{shown} dB"


def unit(form: str, factor: float = 1.0) -> Callable[[float, int], str]:
    """A filter that prints a number with a unit."""

    def shown(value: float, digits: int = 0) -> str:
        if value is None:
            raise Unfounded("the number to print is null in the results")
        return form.format(f"{factor * value:,.{digits}f}")

    return shown


def psnr(value: float | None) -> str:
    """A filter that prints a PSNR of a yardstick: nothing where it is not known."""
    if value is None:
        return ""
    return "no error" if value >= HIGHEST else f"{value:.1f} dB"


FILTERS: dict[str, Callable[..., str]] = {
    "psnr": psnr,
    "number": unit("{}"),
    "dB": unit("{} dB"),
    "s": unit("{} s"),
    "minutes": unit("{} minutes", 1 / 60),
    "ms": unit("{} ms"),
    "percent": unit("{} %", 100),
    "times": unit("{} times"),
    "millions": unit("{} M", 1e-6),
    "thousands": unit("{} k", 1e-3),
    "megabytes": unit("{} MB"),
    "code": "`{}`".format,
    "plus_minus": lambda row, key, digits=1: plus_minus(row, key, digits) or "—",
}


def context(facts: Facts) -> dict[str, Any]:
    """What templates call."""
    public = (name for name in dir(facts) if not name.startswith("_"))
    # It needs Mitsuba, whose variant is chosen by now.
    from unbake.config.fit import GAIN_OF_ROOMS
    from unbake.exports.bake import WANTED
    from unbake.training.path_depth import SHARE

    settings = {"rate_step": STEP, "light_share": SHARE, "least_depth": PAPER_DEPTH}
    settings |= {"score_window": WINDOW, "near_wanted": WANTED}
    settings["planned_gain"] = GAIN_OF_ROOMS
    functions = {"above": above}
    return {name: getattr(facts, name) for name in public} | functions | settings
