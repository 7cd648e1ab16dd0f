"""`unbake bench rates`: it keeps each trial, goes on where it was stopped, and gives defaults."""

import json
import math
import shutil
import subprocess
import sys

import pytest
from support import MPIEXEC, needs_mpi

from unbake.comparison import bench_rates as module
from unbake.comparison.bench_rates import found_defaults, settled
from unbake.comparison.rate_search import beats
from unbake.config import method_defaults
from unbake.config.method_defaults import MethodDefaults
from unbake.experiments.scenes import SCENES
from unbake.imaging.pictures import read_exr, write_exr
from unbake.transport.methods import METHODS


@pytest.fixture
def rates(unbake, cornell, tiny, tmp_path):
    """`rates("direct")` into the file `rates.json`."""

    def run(*methods, data=cornell, steps=2, extra=(), seconds=None, settings=tiny):
        length = ("--steps", steps) if seconds is None else ("--seconds", seconds)
        return unbake("bench", "rates", "--data", data, "--methods", *methods, *length,
                      "--settings", settings, "--out", tmp_path / "rates.json", *extra)  # fmt: skip

    return run


def searches(tmp_path):
    return json.loads((tmp_path / "rates.json").read_text())["searches"]


def test_each_rate_is_tried_and_the_best_is_noted(rates, tmp_path):
    outcome = rates("direct")
    assert outcome.status == 0 and outcome.err == ""
    table = outcome.out[outcome.out.index("Mean PSNR in dB") : outcome.out.index("wrote ")]
    assert max(map(len, table.splitlines())) <= 80
    (search,) = searches(tmp_path)
    assert (search["method"], search["kind"], search["data"]) == ("direct", "room", "cornell")
    assert search["settings"]["steps"] == 2 and search["settings"]["pixels"] == 64
    trials = search["trials"]
    assert trials[0]["factors"] == {"roughness": 1.0, "albedo": 1.0}
    for name in ("roughness", "albedo"):
        assert {0.4, 1.0, 2.5} <= {trial["factors"][name] for trial in trials}
    for trial in (search["untrained"], *trials):
        mean = (trial["albedo_psnr"] + trial["roughness_psnr"]) / 2
        assert trial["score"] == pytest.approx(mean)
    # Fits with other rates come to other values, all from the same start.
    assert len({trial["score"] for trial in trials}) == len(trials)
    fits = [fit for trial in trials for fit in trial["per_seed"]]
    assert all(f["steps"] == 2 and f["seconds"] > 0 and f["machine"]["cores"] for f in fits)
    assert {t["estimator"] for t in trials} == {"all-pairs"}
    kept = {key: search["best"][key] for key in ("factors", "estimator", "score")}
    assert any(kept.items() <= trial.items() for trial in trials)
    found = found_defaults({"searches": [search]})
    assert found == {"direct": {"room": MethodDefaults(search["best"]["factors"])}}


def test_a_search_goes_on_with_the_trials_that_it_has(rates, tmp_path, monkeypatch):
    plain, fitted = module._learn, []

    def learn(fit):
        if len(fitted) == 3:
            raise KeyboardInterrupt
        fitted.append({k: v for k, v in fit.config.rate_factors.items() if k == "albedo"})
        return plain(fit)

    monkeypatch.setattr(module, "_learn", learn)
    assert rates("direct").status == 130
    (stopped,) = searches(tmp_path)
    assert len(stopped["trials"]) == 3 and stopped["best"] is None
    assert found_defaults({"searches": [stopped]}) == {}
    monkeypatch.setattr(module, "_learn", plain)
    assert rates("direct").status == 0
    (ended,) = searches(tmp_path)
    assert ended["trials"][:3] == stopped["trials"] and ended["best"] is not None
    # Another method is added to the file; what is complete is not repeated.
    monkeypatch.setattr(module, "begin_fit", None)
    assert rates("direct").status == 0
    assert searches(tmp_path) == [ended]


@pytest.mark.slow
def test_scores_are_means_over_seeds_which_may_become_more(rates, tmp_path, monkeypatch):
    made = []

    def scores(fit, dataset):
        made.append(fit.config.seed)
        step = math.log(fit.config.rate_factors["albedo"] or 1.0, 2.5)
        # With the first seed alone, a larger rate is better, by luck.
        return {"score": 20 - abs(step - 1) if fit.config.seed == 0 else 20 - 3 * abs(step + 1)}

    monkeypatch.setattr(module, "_scores", scores)
    monkeypatch.setattr(module, "_learn", lambda fit: (1, 0.1))
    assert rates("direct").status == 0
    (lucky,) = searches(tmp_path)
    assert lucky["best"]["factors"]["albedo"] > 2 and set(made) == {0}
    made.clear()
    assert rates("direct", extra=("--seeds", 0, 1)).status == 0
    (search,) = searches(tmp_path)
    # The seeds differ by more than the rates.
    assert search["best"]["factors"]["albedo"] == 1.0 and search["seeds"] == [0, 1]
    assert any(trial["factors"]["albedo"] < 1 for trial in search["trials"])
    known = {json.dumps(trial["factors"]) for trial in lucky["trials"]}
    for trial in search["trials"]:
        own = [fit["seed"] for fit in trial["per_seed"]]
        mean = sum(fit["score"] for fit in trial["per_seed"]) / len(own)
        assert trial["score"] == pytest.approx(mean)
        assert own == [0, 1] or json.dumps(trial["factors"]) in known
    assert made.count(0) < made.count(1), "the fits of the first seed are kept"
    outcome = rates("direct")
    assert outcome.status == 2 and "has more seeds. Give --seeds 0 1" in outcome.err


def test_the_estimator_is_searched_where_paths_are_followed(rates, tiny, tmp_path, monkeypatch):
    """The published one is the first, and an estimator that is asked for is the only one."""
    made = []

    def scores(fit, dataset):
        made.append((fit.config.estimator, fit.config.rate_factors["albedo"]))
        return {"score": 20.0 + (fit.config.estimator == "all-pairs")}

    monkeypatch.setattr(module, "_scores", scores)
    monkeypatch.setattr(module, "_learn", lambda fit: (1, 0.1))
    # Two passes trace more samples in as many steps: such a choice would be no fair one.
    outcome = rates("prb")
    assert outcome.status == 2 and "compared at equal time" in outcome.err
    assert "prb:neural:all-pairs" in outcome.err and outcome.err.count("\n") == 1
    compiled = []
    monkeypatch.setattr(
        module,
        "compile_kernels",
        lambda _, configs, **__: compiled.append([c.estimator for c in configs]),
    )
    assert rates("prb", seconds=5).status == 0
    assert compiled == [["two-pass", "all-pairs"]], "before the first trial's clock starts"
    (search,) = searches(tmp_path)
    assert search["trials"][0]["estimator"] == "two-pass"
    assert search["best"]["estimator"] == "all-pairs"
    found = found_defaults({"searches": [search]})["prb"]["room"]
    assert found == MethodDefaults({"roughness": 1.0, "albedo": 1.0}, "all-pairs")
    # One that is asked for is another search.
    asked = tmp_path / "asked.toml"
    asked.write_text('estimator = "all-pairs"\n' + tiny.read_text())
    outcome = rates("prb", seconds=5, settings=asked)
    assert outcome.status == 2 and "differs in estimators" in outcome.err
    made.clear()
    assert rates("prb:neural:all-pairs").status == 0
    assert {estimator for estimator, _ in made} == {"all-pairs"}


@pytest.mark.slow
def test_the_schedule_is_searched_where_that_is_asked_for(rates, tmp_path, monkeypatch):
    """Its values are recorded, those of all methods first, and become the method's own."""
    made = []

    def scores(fit, dataset):
        final, warm_up = fit.config.final_learning_rate, fit.config.warm_up
        made.append((final, warm_up))
        return {"score": 20 - abs(math.log(final / 0.3125, 2.5)) + (warm_up == 100)}

    monkeypatch.setattr(module, "_scores", scores)
    monkeypatch.setattr(module, "_learn", lambda fit: (1, 0.1))
    own = {"direct": {"room": MethodDefaults(final_learning_rate=0.7, warm_up=9)}}
    monkeypatch.setattr(method_defaults, "METHOD_DEFAULTS", own)
    settings = tmp_path / "open.toml"
    settings.write_text("pixels = 64\nspp = 4\nsteps = 2\n")
    assert rates("direct", extra=("--schedule",), settings=settings).status == 0
    (search,) = searches(tmp_path)
    first = search["trials"][0]
    assert (first["final_learning_rate"], first["warm_up"]) == (0.05, 0)
    best = search["best"]
    assert (best["final_learning_rate"], best["warm_up"]) == (0.3125, 100)
    assert best["factors"] == {"roughness": 1.0, "albedo": 1.0}
    assert (0.78125, 0) in made and (0.3125, 250) in made, "both sides are tried"
    found = found_defaults({"searches": [search]})["direct"]["room"]
    assert (found.final_learning_rate, found.warm_up) == (0.3125, 100)
    # Without it, a search has the schedule of all methods, whatever was found; and its own file.
    outcome = rates("direct", settings=settings)
    assert outcome.status == 2 and "final_learning_rate, warm_up. Give another" in outcome.err
    (tmp_path / "rates.json").unlink()
    made.clear()
    assert rates("direct", settings=settings).status == 0
    assert set(made) == {(0.05, 0)} and "warm_up" not in searches(tmp_path)[0]["best"]


def trial(albedo, estimator, *scores):
    per_seed = [{"seed": seed, "score": score} for seed, score in enumerate(scores)]
    mean = sum(scores) / len(scores)
    factors = {"albedo": albedo}
    return {"factors": factors, "estimator": estimator, "score": mean, "per_seed": per_seed}


def test_ties_keep_the_published_estimator_and_the_own_rates():
    """The gain of one seed is 0.8 dB above that of the other: a deviation of 0.57."""
    own = trial(1.0, "two-pass", 20.0, 25.0)
    for gain, taken in ((0.5, False), (0.7, True)):
        other = trial(1.0, "all-pairs", 20.4 + gain, 24.6 + gain)
        assert settled([own, other], other) == (other if taken else own)
        higher = trial(2.5, "two-pass", 20.4 + gain, 24.6 + gain)
        assert settled([own, higher], higher) == (higher if taken else own)
    # The best trial has both; its rates matter, its estimator does not.
    higher, both = (trial(2.5, e, 22.0, 27.4) for e in ("two-pass", "all-pairs"))
    assert settled([own, higher, both], both) == higher
    # Methods that follow no paths have one estimator.
    pairs = [trial(factor, "all-pairs", 20.0 + factor) for factor in (1.0, 2.5)]
    assert settled(pairs, pairs[1]) == pairs[1]
    failed = trial(2.5, "two-pass", 1.0) | {"score": None, "per_seed": [{"seed": 0, "score": None}]}
    assert settled([failed, own], own) == own


@pytest.mark.parametrize(
    ("unknown", "key", "name"),
    [
        pytest.param("lighting", "relight_psnr", "environment", marks=pytest.mark.slow),
        ("emission", "emission_db", "emission"),
    ],
)
def test_light_is_judged_too(unknown, key, name, unbake, tiny, tmp_path):
    scene = {"lighting": "still", "emission": "cornell"}[unknown]
    data = tmp_path / "data"
    small = ("--views", 2, "--held-out", 1, "--resolution", 12, "--spp", 4, "--max-depth", 4)
    assert unbake("capture", scene, "--out", data, *small).status == 0
    settings = tmp_path / "light.toml"
    settings.write_text(f'unknown = "{unknown}"\n[lighting]\nresolution = 8\n')
    out = tmp_path / "rates.json"
    words = ("--data", data, "--methods", "direct", "--settings", settings, "--out", out)
    assert unbake("bench", "rates", *words, "--steps", 2).status == 0
    (search,) = searches(tmp_path)
    assert search["unknown"] == unknown and set(search["best"]["factors"]) == {name}
    assert all(trial["score"] == trial[key] for trial in search["trials"])
    assert {0.4, 1.0, 2.5} <= {trial["factors"][name] for trial in search["trials"]}


def test_albedo_whose_scale_is_open_is_judged_after_alignment(
    rates, unbake, tiny, tmp_path, monkeypatch
):
    data = tmp_path / "data"
    small = ("--views", 2, "--held-out", 1, "--resolution", 12, "--spp", 4, "--max-depth", 4)
    assert unbake("capture", "still", "--out", data, *small).status == 0
    both = tmp_path / "both.toml"
    light = "[lighting]\nresolution = 8\n"
    both.write_text('unknown = "materials+lighting"\n' + tiny.read_text() + light)
    monkeypatch.setattr(module, "_learn", lambda fit: (1, 0.1))
    assert rates("direct", data=data, settings=both).status == 0
    (search,) = searches(tmp_path)
    for row in (search["untrained"], *search["trials"]):
        assert row["albedo_psnr"] is not None
        keys = ("albedo_psnr_aligned", "roughness_psnr", "relight_psnr")
        judged = [row[key] for key in keys if row[key] is not None]
        assert len(judged) >= 2 and row["score"] == pytest.approx(sum(judged) / len(judged))
    # An earlier version judged by plain albedo: such fits are read, and not mixed with others.
    file = tmp_path / "rates.json"
    content = json.loads(file.read_text())
    for row in (content["searches"][0]["untrained"], *content["searches"][0]["trials"]):
        for fit in (row, *row["per_seed"]):
            del fit["albedo_psnr_aligned"]
    file.write_text(json.dumps(content))
    outcome = rates("direct", data=data, settings=both, extra=("--seeds", 0, 1))
    assert outcome.status == 2 and "differs in scores, which are of albedo before" in outcome.err
    assert found_defaults(content)["direct"]


@pytest.mark.parametrize("out", [".", "there/rates.json"])
def test_a_file_that_cannot_be_written_is_told_before_the_search(
    out, unbake, cornell, tiny, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there").write_text("a file")
    monkeypatch.setattr(module, "bench_rates", None)
    words = ("--data", cornell, "--methods", "direct", "--settings", tiny, "--out", out)
    outcome = unbake("bench", "rates", *words)
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert "the file cannot be written" in outcome.err


def test_negative_pixels_are_taken_as_zero_where_that_is_asked_for(
    rates, cornell, tmp_path, monkeypatch
):
    data = shutil.copytree(cornell, tmp_path / "data", ignore=lambda *_: [".cache"])
    image = data / "images" / "train_000.exr"
    write_exr(image, -1 - read_exr(image))
    monkeypatch.setattr(module, "_learn", lambda fit: (1, 0.1))
    outcome = rates("direct", data=data)
    assert outcome.status == 2 and "Pass --clip-negative" in outcome.err
    assert rates("direct", data=data, extra=("--clip-negative",)).status == 0


def test_a_method_that_fails_is_recorded(rates, tmp_path, monkeypatch):
    from unbake.errors import UserError

    def learn(fit):
        raise UserError("no memory for a step of 256 paths")

    monkeypatch.setattr(module, "_learn", learn)
    outcome = rates("direct")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert "no memory for a step" in outcome.err
    (search,) = searches(tmp_path)
    assert search["best"] is None and "no memory" in search["trials"][0]["error"]
    monkeypatch.setattr(module, "_learn", lambda fit: (1, 0.1))
    monkeypatch.setattr(module, "_scores", lambda fit, dataset: {"score": 20.0})
    assert rates("direct").status == 0, "what failed is tried again"
    (search,) = searches(tmp_path)
    assert search["best"]["score"] == 20 and not any("error" in t for t in search["trials"])


def test_a_search_that_fails_does_not_end_the_others(rates, tmp_path, monkeypatch):
    from unbake.errors import UserError

    def learn(fit):
        if fit.config.method == "direct":
            raise UserError("no memory for a step of 256 paths")
        return 1, 0.1

    monkeypatch.setattr(module, "_learn", learn)
    monkeypatch.setattr(module, "_scores", lambda fit, dataset: {"score": 20.0})
    outcome = rates("direct", "no-prior")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert "cornell, direct: no memory for a step" in outcome.err
    failed, done = searches(tmp_path)
    assert failed["best"] is None and done["best"] is not None
    table = outcome.out[outcome.out.index("Mean PSNR in dB") :]
    assert "no-prior" in table and "direct" not in table


@needs_mpi
def test_processes_share_the_searches(rates, cornell, tiny, tmp_path):
    words = ("bench", "rates", "--data", cornell, "--methods", "direct", "no-prior", "--steps", 2)
    words += ("--settings", tiny, "--out", tmp_path / "rates.json")
    start = [MPIEXEC, "-n", "2", sys.executable, "-m", "unbake"]
    done = subprocess.run([*start, *map(str, words)], capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("wrote ") == 1 and not done.stderr
    assert [file.name for file in tmp_path.glob("rates.json*")] == ["rates.json"]
    found = searches(tmp_path)
    assert [search["method"] for search in found] == ["direct", "no-prior"]
    assert all(search["best"] and len(search["trials"]) >= 5 for search in found)
    # One process has nothing left to do.
    before = (tmp_path / "rates.json").read_bytes()
    assert rates("direct", "no-prior").status == 0
    assert (tmp_path / "rates.json").read_bytes() == before


def test_a_search_of_another_process_goes_on(rates, tmp_path, monkeypatch):
    """Its part of the record is beside the file if all were stopped."""
    assert rates("direct", "no-prior").status == 0
    file, part = tmp_path / "rates.json", tmp_path / "rates.json.process-1"
    whole = json.loads(file.read_text())
    part.write_text(json.dumps({**whole, "searches": whole["searches"][1:]}))
    second = {**whole["searches"][1], "trials": whole["searches"][1]["trials"][:2], "best": None}
    file.write_text(json.dumps({**whole, "searches": [whole["searches"][0], second]}))
    monkeypatch.setattr(module, "begin_fit", None)  # nothing is left to do
    assert rates("direct", "no-prior").status == 0
    assert json.loads(file.read_text()) == whole and not part.exists()
    # A part that is older than the file, and one of a search that the file lacks.
    part.write_text(json.dumps({**whole, "searches": [second]}))
    assert rates("direct").status == 0 and searches(tmp_path) == whole["searches"]
    part.write_text(json.dumps({**whole, "searches": whole["searches"][1:]}))
    file.write_text(json.dumps({**whole, "searches": whole["searches"][:1]}))
    assert rates("direct").status == 0 and searches(tmp_path) == whole["searches"]
    lacking = [
        {key: value for key, value in second.items() if key != left_out}
        for left_out in ("trials", "best", "seeds", "settings")
    ]
    for damaged in ({}, *lacking, {**second, "untrained": {}}, {**second, "trials": [None]}):
        part.write_text(json.dumps({**whole, "searches": [damaged]}))
        outcome = rates("direct")
        assert outcome.status == 2 and "process-1: no record of searches" in outcome.err


def test_other_settings_are_not_mixed_in(rates, cornell, tmp_path):
    assert rates("direct").status == 0
    before = (tmp_path / "rates.json").read_bytes()
    outcome = rates("direct", steps=3)
    assert outcome.status == 2 and "differs in settings, steps. Give another --out" in outcome.err
    data = shutil.copytree(cornell, tmp_path / "other" / "cornell")
    content = json.loads((data / "transforms.json").read_text())
    content["frames"] = [f for f in content["frames"] if f["file_path"] != "images/train_001.exr"]
    (data / "transforms.json").write_text(json.dumps(content))
    outcome = rates("direct", data=data)
    assert outcome.status == 2 and "differs in views, files" in outcome.err
    photograph = next((data / "images").glob("*.exr"))
    shutil.rmtree(data)
    shutil.copytree(cornell, data)
    write_exr(photograph, 2 * read_exr(photograph))
    outcome = rates("direct", data=data)
    assert outcome.status == 2 and "differs in files. Give another --out" in outcome.err
    assert (tmp_path / "rates.json").read_bytes() == before


def test_data_sets_of_the_same_name_are_not_confused(rates, cornell, unbake, tiny, tmp_path):
    other = shutil.copytree(cornell, tmp_path / "other" / cornell.name)
    words = ("--methods", "direct", "--steps", 2, "--settings", tiny, "--out", tmp_path / "r.json")
    outcome = unbake("bench", "rates", "--data", cornell, other, *words)
    assert outcome.status == 2 and "two data sets have the same name" in outcome.err


def test_two_searches_of_a_kind_of_scene_give_no_default():
    search = {"method": "prb", "kind": "room", "follows_paths": True}
    best = {"factors": {"albedo": 1.0}, "estimator": "two-pass"}
    with pytest.raises(ValueError, match="prb was searched in two scenes"):
        found_defaults({"searches": [search | {"best": best}, search | {"best": best}]})


def test_without_truth_there_is_nothing_to_judge_by(rates, cornell, tmp_path):
    data = shutil.copytree(cornell, tmp_path / "data")
    shutil.rmtree(data / "truth")
    outcome = rates("direct", data=data)
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert "no held-out view with true materials" in outcome.err


def test_the_defaults_of_methods_are_those_that_were_found(repository):
    """The table in the code repeats the committed search, and is empty without one."""
    file = repository / "benchmarks" / "results" / "rates.json"
    record = json.loads(file.read_text()) if file.is_file() else {"searches": []}
    # No scene of a table: its rates would be chosen by the result that they are judged by.
    judged = {"demo", "staircase", *(scene.folder for scene in SCENES)}
    assert not judged & {search["data"] for search in record["searches"]}
    for search in record["searches"]:
        (best,) = (row for row in search["trials"] if search["best"].items() <= row.items())
        assert settled(search["trials"], best) == best
        top = max(search["trials"], key=lambda row: row["score"])
        scores = [[fit["score"] for fit in row["per_seed"]] for row in (top, best)]
        assert not beats(*scores)
    found = found_defaults(record)
    # The fields' rates were chosen for ours, which is not given more.
    assert method_defaults.METHOD_DEFAULTS == {k: v for k, v in found.items() if k != "ours"}
    assert not found.keys() & method_defaults.SAME_AS.keys()
    assert found.keys() <= METHODS.keys()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--data", "x", "--methods", "prb", "--steps", 0), "--steps: must be 1 or more"),
        (("--data", "x", "--methods", "prb", "--steps", 1, "--seconds", 1), "--steps: cannot"),
        (("--data", "x", "--methods", "prb"), "x: the data folder does not exist"),
    ],
)
def test_a_wrong_word_is_named(words, message, unbake, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    outcome = unbake("bench", "rates", "--out", "o.json", *words)
    assert outcome.status == 2 and outcome.err.startswith(f"error: {message}"), outcome.err
