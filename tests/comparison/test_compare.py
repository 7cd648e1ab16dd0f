"""Comparisons: complete, taken up again, honest about what failed."""

import dataclasses
import io
import json
import shutil
import subprocess
import sys

import pytest
from rich.console import Console
from support import MPIEXEC, interrupt_at, needs_mpi

from unbake.acquisition.capture import capture
from unbake.acquisition.settings import CaptureSettings
from unbake.comparison import compare as module
from unbake.comparison.method_variant import MethodVariant
from unbake.config import FitConfig, read_toml
from unbake.errors import UserError
from unbake.evaluation import yardsticks
from unbake.evaluation.evaluate import evaluate
from unbake.evaluation.settings import EvaluationSettings
from unbake.imaging.pictures import read_exr, write_exr
from unbake.machine import machine
from unbake.ranks import Ranks
from unbake.training import loop
from unbake.training.checkpoint import newest_progress
from unbake.training.run_folder import RunFolder


@pytest.fixture(autouse=True)
def short_ceilings(monkeypatch):
    """Ceilings take a second, once for all tests of the same data set."""
    monkeypatch.setattr(yardsticks, "STEPS", 20)


@pytest.fixture
def compare(unbake, cornell, tiny, tmp_path):
    """`compare("ours", "direct", "--steps", 5)` into the folder `out`."""

    def run(*methods, steps=8, extra=(), data=cornell):
        return unbake("compare", data, "--methods", *methods, "--out", tmp_path / "out",
                      "--settings", tiny, "--steps", steps, "--score-seconds", 0.000001,
                      "--evaluate-spp", 2, *extra)  # fmt: skip

    return run


def result(tmp_path):
    return json.loads((tmp_path / "out" / "compare.json").read_text())


def contents(folder):
    return {p: (p.read_bytes(), p.stat().st_mtime_ns) for p in folder.rglob("*") if p.is_file()}


def test_two_methods_side_by_side(compare, tmp_path):
    outcome = compare("ours", "direct")
    assert outcome.status == 0 and outcome.err == ""
    out = tmp_path / "out"
    made = {"untrained", "ours", "direct", "compare.json", "report.html"}
    assert {p.name for p in out.iterdir()} == made
    found = result(tmp_path)
    assert list(found["methods"]) == ["ours", "direct"]
    for name, row in found["methods"].items():
        config = read_toml(out / name / "config.toml")
        assert config.method == row["method"] == name
        assert (row["steps"], row["samples"], config.steps) == (8, 8 * 256, 8)
        rate = 1e3 * 256 / row["milliseconds_per_step"]
        assert row["samples_per_second"] == pytest.approx(rate)
        assert 0 < row["milliseconds_per_step"] < 1e3 * row["seconds"]
        assert row["start_up_seconds"] >= 0 and row["memory_mb"] > 10
        assert row["rate_factors"].keys() == {"albedo", "roughness"}
        assert row["rate_factors"] == {k: config.rate_factors[k] for k in row["rate_factors"]}
        assert row["estimator"] == "all-pairs" and row["representation"] == "neural"
        assert row["radiance"] == {"ours": "neural", "direct": None}[name]
        settings = ("final_learning_rate", "warm_up", "beta2", "least_slope")
        assert [row[key] for key in settings] == [getattr(config, key) for key in settings]
        searches = newest_progress(RunFolder(out / name)).searched
        assert row["searches"] == searches
        metrics = json.loads((out / name / "evaluation" / "metrics.json").read_text())
        assert row["heldout"] == metrics["heldout"] and row["train"] == metrics["train"]
        assert [point["step"] for point in row["score"]] == [0, 4, 8]
        gap = row["score"][-1]["albedo_psnr"] - row["heldout"]["albedo_psnr"]
        assert abs(gap) < 0.5
    assert found["machine"]["cores"] >= 1 and found["evaluation"]["spp"] == 2
    assert found["settings"]["pixels"] == 64
    for target in found["time_to_quality"]:
        last = found["methods"][target["run"]]["score"][-1][f"{target['quantity']}_psnr"]
        assert target["psnr"] == pytest.approx(last - target["below"])
        assert target["seconds"].keys() == {"ours", "direct"}
        own = target["seconds"][target["run"]]
        assert 0 <= own <= found["methods"][target["run"]]["score"][-1]["seconds"]
    raced = {(t["run"], t["quantity"]) for t in found["time_to_quality"] if t["below"] == 0}
    assert raced == {(run, name) for run in ("ours", "direct") for name in ("albedo", "roughness")}
    assert found["format"] == 2 and "1 and 2 dB" in found["definitions"]["time_to_quality"]
    assert found["methods"]["direct"]["beta2"] > found["methods"]["ours"]["beta2"]
    assert found["definitions"].keys() >= {*settings, "searches"}
    assert "ms a" in outcome.out and "Seconds to roughness PSNR" in outcome.out
    page = (out / "report.html").read_text()
    assert "Time to quality" in page and "Held-out albedo PSNR" in page
    assert "all pairs" in page and "Validation during training" not in page


def test_kernels_are_compiled_before_the_clock_of_a_fit_starts(
    cornell, tiny, tmp_path, unbake, monkeypatch
):
    calls = []

    def compiled(dataset, configs, **_):
        calls.extend(f"compile {config.method}" for config in configs)

    def fitted(data, out, settings, **words):
        calls.append(f"fit {settings.method}")
        return loop.fit(data, out, settings, **words)

    monkeypatch.setattr(module, "compile_kernels", compiled)
    monkeypatch.setattr(module, "fit", fitted)
    words = ("compare", cornell, "--methods", "ours", "direct", "--out", tmp_path / "out")
    words += ("--settings", tiny, "--seconds", 0.1, "--score-seconds", 0, "--evaluate-spp", 2)
    assert unbake(*words).status == 0
    methods = ("compile ours", "fit ours", "compile direct", "fit direct")
    assert calls == ["fit direct", *methods], "the untrained fields come first"
    calls.clear()
    assert unbake(*words).status == 0
    assert not [call for call in calls if call.startswith("compile")], "nothing is left to do"
    # A fit that was interrupted has kernels to compile in this process, as others have.
    progress = newest_progress(RunFolder(tmp_path / "out" / "direct"))
    part = dataclasses.replace(progress, seconds=0.05)
    monkeypatch.setattr(
        module, "newest_progress", lambda run: part if run.path.name == "direct" else progress
    )
    calls.clear()
    assert unbake(*words).status == 0
    assert [call for call in calls if call.startswith("compile")] == ["compile direct"]


def test_only_the_method_differs_and_what_belongs_to_it(compare, tmp_path):
    assert compare("ours", "direct", steps=2).status == 0
    ours, direct = (
        vars(read_toml(tmp_path / "out" / n / "config.toml")) for n in ("ours", "direct")
    )
    differing = {key for key in ours if ours[key] != direct[key]}
    assert differing == {"method", "beta2", "least_slope"}


def test_the_untrained_fields_stand_beside_the_methods(compare, tmp_path):
    outcome = compare("ours", "direct", steps=3)
    found, out = result(tmp_path), tmp_path / "out"
    start, metrics = (
        found["untrained"],
        json.loads((out / "untrained/evaluation/metrics.json").read_text()),
    )
    assert metrics["steps"] == metrics["samples"] == metrics["seconds"] == 0
    assert start["heldout"] == metrics["heldout"] and start["train"] == metrics["train"]
    assert start["representation"] == "neural" and start["quantities"] == ["albedo", "roughness"]
    # These are the fields that the methods start from; and no method or time belongs to them.
    first = found["methods"]["ours"]["score"][0]
    assert first["step"] == 0
    assert start["heldout"]["albedo_psnr"] == pytest.approx(first["albedo_psnr"], abs=0.2)
    assert not start.keys() & {"method", "seconds", "milliseconds_per_step", "score", "memory_mb"}
    assert "untrained" not in found["methods"]
    for target in found["time_to_quality"]:
        assert target["run"] != "untrained" and "untrained" not in target["seconds"]
    table = outcome.out[outcome.out.index("Held-out views, PSNR in dB") :]
    assert table.index("untrained") < table.index("ours") < table.index("direct")
    page = (out / "report.html").read_text()
    assert '<td class="method">untrained' in page
    race = page.split('<table class="race">')[1].split("</table>")[0]
    assert "untrained" not in race and "direct" in race

    before = contents(out / "untrained")
    assert compare("ours", "direct", steps=3).status == 0
    kept = contents(out / "untrained")
    # As of any run that is kept; the lock has the number of the process that held it last.
    rewritten = {"config.toml", "origin.json", "log.jsonl", ".lock"}
    assert before.keys() == kept.keys()
    for file, content in before.items():
        same = content[0] == kept[file][0] if file.name in rewritten else content == kept[file]
        assert same, file


def test_the_ceiling_of_the_fields_stands_below_the_methods(compare, cornell, tmp_path):
    data = shutil.copytree(cornell, tmp_path / "data", ignore=lambda *_: [".cache"])
    outcome = compare("direct", "no-prior", "direct:grid", steps=2, data=data)
    assert outcome.status == 0 and outcome.err == ""
    # Measured once for all methods with the same fields.
    assert outcome.out.count("on the true maps of 2 training views") == 2
    found = result(tmp_path)["methods"]
    ceilings = {name: row["yardsticks"]["ceiling"] for name, row in found.items()}
    assert ceilings["direct"] == ceilings["no-prior"] != ceilings["direct-grid"]
    metrics = json.loads((tmp_path / "out/direct/evaluation/metrics.json").read_text())
    assert metrics["yardsticks"] == found["direct"]["yardsticks"]
    table = outcome.out[outcome.out.index("Held-out views, PSNR in dB") :]
    for scores in ceilings.values():
        assert f"{scores['albedo_psnr']:.1f}" in table
    assert table.index("no-prior") < table.index("constant") < table.index("ceiling")
    page = (tmp_path / "out" / "report.html").read_text()
    assert page.count('<tr><th scope="row">Ceiling</th>') == 2
    assert page.count('<tr><th scope="row">Constant</th>') == 1
    assert "<small>of direct and no-prior</small>" in page
    gap = found["direct"]["heldout"]["albedo_psnr"] - ceilings["direct"]["albedo_psnr"]
    assert f"<small>{'−' if gap < 0 else '+'}{abs(gap):.2f}</small>" in page

    # An evaluation of before the ceiling was measured does not hide it
    file = tmp_path / "out/direct/evaluation/metrics.json"
    file.write_text(json.dumps(metrics | {"yardsticks": metrics["yardsticks"] | {"ceiling": None}}))
    again = compare("direct", "no-prior", "direct:grid", steps=2, data=data)
    assert again.status == 0 and "on the true maps" not in again.out
    assert result(tmp_path)["methods"]["direct"]["yardsticks"]["ceiling"] == ceilings["direct"]


def test_without_true_maps_there_is_no_ceiling(compare, cornell, tmp_path):
    data = shutil.copytree(cornell, tmp_path / "data", ignore=lambda *_: [".cache"])
    shutil.rmtree(data / "truth")
    outcome = compare("direct", steps=2, data=data)
    assert outcome.status == 0 and "ceiling" not in outcome.out
    assert result(tmp_path)["methods"]["direct"]["yardsticks"]["ceiling"] is None
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Ceiling</th>" not in page and "Constant</th>" not in page


def test_finished_runs_are_kept(compare, tmp_path):
    assert compare("direct", steps=3).status == 0
    run = tmp_path / "out" / "direct"
    kept = {p for p in run.rglob("*") if p.parent.name in ("checkpoints", "heldout", "previews")}
    before = {p: v for p, v in contents(run).items() if p in kept}
    log = (run / "log.jsonl").read_text()
    assert compare("direct", "ours", steps=3).status == 0
    assert before == {p: v for p, v in contents(run).items() if p in kept} and len(before) > 4
    assert log == (run / "log.jsonl").read_text()
    assert list(result(tmp_path)["methods"]) == ["direct", "ours"]


@pytest.mark.slow
def test_another_quality_of_evaluation_is_evaluated_anew(compare, tmp_path):
    assert compare("direct", steps=2).status == 0
    assert compare("direct", steps=2, extra=("--evaluate-spp", 3)).status == 0
    metrics = json.loads((tmp_path / "out/direct/evaluation/metrics.json").read_text())
    assert metrics["render"]["spp"] == result(tmp_path)["evaluation"]["spp"] == 3


@pytest.mark.parametrize(
    "changes",
    [
        {"train_views": 1},
        {"clip_negative": True},
        {"material_spp": 3},
        {"rr_depth": 2},
    ],
)
@pytest.mark.slow
def test_an_evaluation_with_other_settings_is_repeated(changes, cornell, tiny, tmp_path):
    config = dataclasses.replace(read_toml(tiny), steps=1)
    console = Console(file=io.StringIO())

    def go(**settings):
        evaluation = EvaluationSettings(spp=2, **settings)
        variants = [MethodVariant("direct")]
        module.compare(cornell, variants, tmp_path, config, evaluation=evaluation, console=console)
        file = tmp_path / "direct" / "evaluation" / "metrics.json"
        return file.stat().st_mtime_ns, json.loads(file.read_text())["evaluation"]

    first, again, (time, other) = go(), go(), go(**changes)
    assert first == again and time != first[0]
    assert other == first[1] | changes


def test_paths_may_be_texts(cornell, tiny, tmp_path):
    config = dataclasses.replace(read_toml(tiny), steps=1)
    small = CaptureSettings(views=1, held_out=0, resolution=8, spp=4, max_depth=3)
    data = str(tmp_path / "data")
    capture("cornell", data, small, tell=lambda line: None)
    run = str(tmp_path / "run")
    assert module.fit(data, run, config, console=Console(file=io.StringIO())).step == 1
    metrics = evaluate(run, EvaluationSettings(spp=1), tell=lambda line: None)
    assert metrics["steps"] == 1
    out, variants = str(tmp_path / "out"), [MethodVariant("direct")]
    evaluation = EvaluationSettings(spp=1)
    console = Console(file=io.StringIO())
    found = module.compare(data, variants, out, config, evaluation=evaluation, console=console)
    assert found["methods"]["direct"]["steps"] == 1


def test_an_interrupted_comparison_goes_on(compare, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        interrupt_at(patch, 4)
        outcome = compare("direct", "ours")
    assert outcome.status == 130 and "the same command goes on" in outcome.out
    assert not (tmp_path / "out" / "ours").exists()
    assert not (tmp_path / "out" / "compare.json").exists()
    outcome = compare("direct", "ours")
    assert outcome.status == 0 and "going on after step 5" in outcome.out
    assert [row["steps"] for row in result(tmp_path)["methods"].values()] == [8, 8]
    assert [p["step"] for p in result(tmp_path)["methods"]["direct"]["score"]] == [0, 4, 5, 8]


def test_a_method_that_fails_is_recorded_and_the_others_go_on(compare, tmp_path, monkeypatch):
    real = module.fit

    def out_of_memory(data, run, config, **named):
        if config.method == "ours":
            raise UserError("out of memory: a <step> needs 9 GB", "ours", "Lower --batch")
        return real(data, run, config, **named)

    monkeypatch.setattr(module, "fit", out_of_memory)
    outcome = compare("ours", "direct", steps=3)
    assert outcome.status == 1 and "Traceback" not in outcome.err
    said = "ours: out of memory: a <step> needs 9 GB. Lower --batch"
    assert f"error: {said}" in outcome.out
    found = result(tmp_path)
    assert found["methods"]["ours"]["error"] == said
    assert found["methods"]["ours"]["method"] == "ours"
    assert found["methods"]["direct"]["steps"] == 3
    assert {t["run"] for t in found["time_to_quality"]} == {"direct"}
    assert found["time_to_quality"][0]["seconds"]["ours"] is None
    page = (tmp_path / "out" / "report.html").read_text()
    assert "a &lt;step&gt; needs 9 GB" in page

    monkeypatch.setattr(module, "fit", real)
    assert compare("ours", "direct", steps=3).status == 0
    assert "error" not in result(tmp_path)["methods"]["ours"]


def test_a_method_without_memory_fails_alone_and_a_mistake_ends_all(compare, tmp_path, monkeypatch):
    real = module.fit

    def failing(error):
        def fit(data, run, config, **named):
            if config.method == "ours":
                raise error
            return real(data, run, config, **named)

        return fit

    monkeypatch.setattr(module, "fit", failing(RuntimeError("jit_malloc(): out of memory!")))
    outcome = compare("ours", "direct", steps=3)
    assert outcome.status == 1 and "error: out of memory. Lower the resolution" in outcome.out
    assert result(tmp_path)["methods"]["ours"]["error"].startswith("out of memory. Lower")
    assert result(tmp_path)["methods"]["direct"]["steps"] == 3
    monkeypatch.setattr(module, "fit", failing(RuntimeError("a mistake")))
    with pytest.raises(RuntimeError, match="a mistake"):
        compare("ours", "direct", steps=3)


def test_rows_and_errors_of_all_ranks_come_together():
    told = [
        {"rows": {"a": {"steps": 3}}, "errors": {}},
        {"rows": {"b": {"error": "bad"}}, "errors": {"b": ["bad", "a file", None]}},
    ]

    class Two(Ranks):
        def gather(self, own):
            assert json.loads(json.dumps(own)) == told[1]
            return told

    error = UserError("bad", "a file")
    rows, errors = module._of_all(Two(), told[1]["rows"], {"b": error})
    assert rows == {"a": {"steps": 3}, "b": {"error": "bad"}}
    assert list(errors) == ["b"] and str(errors["b"]) == str(error)


@needs_mpi
def test_processes_share_the_methods(compare, cornell, tiny, tmp_path):
    out, data = tmp_path / "out", shutil.copytree(cornell, tmp_path / "data")
    shutil.rmtree(data / "truth")  # ceilings take as long as they need
    words = ("compare", data, "--methods", "direct", "no-prior", "--out", out)
    words += ("--settings", tiny, "--steps", 8, "--score-seconds", 0.000001, "--evaluate-spp", 2)
    start = [MPIEXEC, "-n", "2", sys.executable, "-m", "unbake"]
    done = subprocess.run([*start, *map(str, words)], capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("compare.json") == 1 and not done.stderr
    found = result(tmp_path)
    assert list(found["methods"]) == ["direct", "no-prior"] and found["untrained"]["heldout"]
    assert [row["steps"] for row in found["methods"].values()] == [8, 8]
    kept = [out / name / "evaluation" for name in ("untrained", "direct", "no-prior")]
    before = [contents(folder) for folder in kept]
    assert compare("direct", "no-prior", data=data).status == 0  # one process finds all done
    assert all(before) and [contents(folder) for folder in kept] == before


def test_where_every_method_fails_the_first_error_is_told(compare, cornell, tmp_path):
    data = shutil.copytree(cornell, tmp_path / "data")
    image = data / "images" / "train_000.exr"
    write_exr(image, -1 - read_exr(image))
    outcome = compare("direct", data=data)
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert "pixels are negative" in outcome.err
    assert not (tmp_path / "out" / "compare.json").exists()
    assert compare("direct", data=data, steps=2, extra=("--clip-negative",)).status == 0


def test_without_truth_there_are_no_scores_and_no_race(compare, cornell, tmp_path):
    data = shutil.copytree(cornell, tmp_path / "data")
    shutil.rmtree(data / "truth")
    assert compare("direct", "ours", steps=2, data=data).status == 0
    found = result(tmp_path)
    assert found["time_to_quality"] == []
    assert found["methods"]["ours"]["heldout"]["albedo_psnr"] is None
    assert found["methods"]["ours"]["heldout"]["render_psnr"] is not None


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("best",), "--methods: no method named 'best'. There are ours, "),
        (("ours:voxels",), "--methods: no representation named 'voxels'. There are neural, grid"),
        (("ours:",), "--methods: no representation named ''"),
        (("ours", "ours"), "--methods: a method is given twice"),
        (("ours", "--seconds", 3), "--steps: cannot be given together with --seconds"),
        (("ours", "--preset", "cpu"), "--preset: cannot be given together with --settings"),
        (("ours", "--score-seconds", -1), "--score-seconds: must be 0 or more"),
        (("ours", "--evaluate-spp", 0), "--evaluate-spp: must be 1 or more"),
        (("ours", "--spp", 3), "--spp: must be an even number"),
    ],
)
def test_a_wrong_word_is_named(words, message, compare, tmp_path):
    methods = [word for word in words if str(word).partition(":")[0] in ("ours", "best")]
    outcome = compare(*methods, extra=words[len(methods) :])
    assert outcome.status == 2 and outcome.err.startswith(f"error: {message}"), outcome.err
    assert outcome.err.count("\n") == 1 and not (tmp_path / "out").exists()


def test_data_that_is_not_there_is_named(compare, tmp_path):
    outcome = compare("ours", data=tmp_path / "none")
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert "none: the data folder does not exist" in outcome.err
    assert not (tmp_path / "out").exists()


def test_runs_of_other_settings_or_data_are_not_mixed_in(compare, cornell, tmp_path):
    assert compare("direct", steps=2).status == 0
    before = contents(tmp_path / "out")
    brighter = shutil.copytree(cornell, tmp_path / "other")
    photograph = next((brighter / "images").glob("*.exr"))
    write_exr(photograph, 2 * read_exr(photograph))
    for outcome in (
        compare("direct", steps=3),
        compare("ours", "direct", steps=2, extra=("--seed", 5, "--batch", 16)),
        compare("direct", steps=2, data=brighter),
    ):
        assert outcome.status == 2 and outcome.err.count("\n") == 1
        assert "direct: the run in this folder" in outcome.err
        assert contents(tmp_path / "out") == before
    assert "has other data. Give another --out" in outcome.err


def test_a_data_set_that_has_moved_is_the_same(compare, cornell, tmp_path):
    assert compare("direct", steps=2).status == 0
    moved = shutil.copytree(cornell, tmp_path / "moved")
    outcome = compare("direct", "ours", steps=2, data=moved)
    assert outcome.status == 0, outcome.err
    assert RunFolder(tmp_path / "out" / "direct").origin().data == str(moved.resolve())


def test_runs_of_several_machines_are_told(compare, tmp_path, monkeypatch):
    outcome = compare("direct", steps=2)
    assert outcome.status == 0 and "several machines" not in outcome.out
    own = machine()
    assert result(tmp_path)["methods"]["direct"]["machines"] == [own]
    other = own | {"processor": "another one"}
    monkeypatch.setattr(loop, "machine", lambda: other)
    outcome = compare("direct", "ours", steps=2)
    assert outcome.status == 0 and "runs are of several machines" in outcome.out
    rows = result(tmp_path)["methods"]
    assert [rows[name]["machines"] for name in ("direct", "ours")] == [[own], [other]]


def test_other_numbers_of_threads_are_other_machines(compare, tmp_path, monkeypatch):
    assert compare("direct", steps=2).status == 0
    own = machine()
    other = own | {"threads": own["threads"] + 1}
    monkeypatch.setattr(loop, "machine", lambda: other)
    outcome = compare("direct", "ours", steps=2)
    assert outcome.status == 0 and "several machines or numbers of threads" in outcome.out
    # A record of before the number was kept says nothing of it.
    run = RunFolder(tmp_path / "out" / "direct")
    del own["threads"]
    run.write_origin(dataclasses.replace(run.origin(), machines=(own,)))
    outcome = compare("direct", "ours", steps=2)
    assert outcome.status == 0 and "several machines" not in outcome.out
    assert run.origin().on(other) == run.origin()


def test_a_folder_that_cannot_be_written_is_told_before_any_work(compare, tmp_path, monkeypatch):
    (tmp_path / "out").write_text("a file")
    monkeypatch.setattr(module.Dataset, "load", None)
    outcome = compare("direct", steps=2)
    assert outcome.status == 2 and outcome.err.count("\n") == 1
    assert "out: is not a folder. Give another --out" in outcome.err


def test_untrained_fields_that_fail_are_a_part_that_failed(compare, tmp_path, monkeypatch):
    real = module.fit

    def failing(data, run, config, **named):
        if not config.steps:
            raise UserError("out of memory")
        return real(data, run, config, **named)

    monkeypatch.setattr(module, "fit", failing)
    assert compare("direct", steps=2).status == 1
    found = result(tmp_path)
    assert found["untrained"]["error"] == "out of memory"
    assert "error" not in found["methods"]["direct"]


def test_no_run_is_written_through_a_link(compare, tmp_path):
    victim = tmp_path / "victim"
    victim.mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "direct").symlink_to(victim)
    outcome = compare("direct", steps=2)
    assert outcome.status == 2 and "direct: is a symbolic link" in outcome.err
    assert not list(victim.iterdir())


def test_a_contender_is_a_method_and_maybe_a_representation():
    shared = FitConfig(bounces=3, prior="one-bounce")
    plain, bitmap = MethodVariant.of("ours"), MethodVariant.of("prb:bitmap")
    assert (plain.name, bitmap.name) == ("ours", "prb-bitmap")
    assert plain.settings(shared) == shared
    chosen = bitmap.settings(shared)
    assert (chosen.method, chosen.representation) == ("prb", "bitmap")
    # Those are settings of ours alone, which the others refuse.
    assert (chosen.bounces, chosen.prior) == (0, "extra-bounce")


@pytest.mark.slow
def test_samples_of_both_passes_count(compare, tmp_path):
    assert compare("direct", "prb:neural:two-pass", "prb:neural:all-pairs").status == 0
    rows = result(tmp_path)["methods"]
    samples = {row["estimator"]: row["samples"] for name, row in rows.items() if "prb" in name}
    assert samples == {"all-pairs": 8 * 256, "two-pass": 2 * 8 * 256}
    assert rows["direct"]["samples"] == 8 * 256
    for name, row in rows.items():
        log = (tmp_path / "out" / name / "log.jsonl").read_text().splitlines()
        assert json.loads(log[-1])["samples"] == row["samples"]
        rate = 1e3 * row["samples"] / row["steps"] / row["milliseconds_per_step"]  # no searches
        assert row["samples_per_second"] == pytest.approx(rate)


def test_true_materials_that_are_not_known_are_missed_before_anything_is_fitted(
    compare, cornell, tmp_path
):
    data = shutil.copytree(cornell, tmp_path / "data")
    content = json.loads((data / "transforms.json").read_text())
    del content["render"]
    (data / "transforms.json").write_text(json.dumps(content))
    outcome = compare("direct", data=data, extra=("--evaluate-truth",))
    assert outcome.status == 2 and "does not hold its true materials" in outcome.err
    assert not (tmp_path / "out").exists()
