"""Files of other versions: those of the first release are read, newer ones refused in one line."""

import json
import shutil

import numpy as np
import pytest

from unbake.dataset.data_folder import DataFolder
from unbake.dataset.views import Dataset
from unbake.errors import UserError
from unbake.evaluation.evaluate import evaluate
from unbake.evaluation.settings import EvaluationSettings
from unbake.report.page import write_report
from unbake.training import checkpoint
from unbake.training.recovered import load_run
from unbake.training.run_folder import RunFolder
from unbake.training.state import initial_state

#: How the data set was made and the run evaluated, 0.1: capture cornell --views 2 --held-out 1
#: --resolution 16 --spp 16 --max-depth 6; fit with tiny networks; evaluate --spp 16 --max-depth 6
#: --train-views 1. Pictures for display are left out, and `data` is a relative path.
EVALUATED = EvaluationSettings(spp=16, max_depth=6, train_views=1)


@pytest.fixture
def first(repository, tmp_path):
    """A copy of a data set and a run that version 0.1 wrote: `data` and `run` in this folder."""
    return shutil.copytree(repository / "tests" / "data" / "version-0.1", tmp_path / "first")


@pytest.fixture
def run(first):
    return RunFolder(first / "run")


def psnrs(metrics):
    found = {s: metrics[s] for s in ("heldout", "train")}
    return {f"{s} {k}": v for s, row in found.items() for k, v in row.items() if k != "views"}


def test_a_data_set_of_the_first_version_is_read(first):
    assert "format" not in json.loads((first / "data" / "transforms.json").read_text())
    dataset = Dataset.load(first / "data")
    assert [view.name for view in dataset.views] == ["train_000", "train_001", "heldout_000"]
    assert dataset.background == "visible" and dataset.render["spp"] == 16
    dataset.save(first / "data")
    again = Dataset.load(first / "data")
    assert json.loads((first / "data" / "transforms.json").read_text())["format"] == 1
    assert again.coverage == dataset.coverage
    for old, new in zip(dataset.views, again.views, strict=True):
        assert old.image == new.image
        assert np.array_equal(old.camera.to_world, new.camera.to_world)


def test_a_run_of_the_first_version_is_read_and_evaluated_as_then(first, run):
    assert "format" not in json.loads(run.origin_file.read_text()) | run.metrics()
    recovered = load_run(run.path)
    assert recovered.progress.step == 60 and recovered.config.pixels == 32
    assert recovered.dataset.folder.resolve() == (first / "data").resolve()
    then = psnrs(run.metrics())
    now = psnrs(evaluate(run.path, EVALUATED, tell=lambda line: None))
    assert len(then) == 8 and then.keys() <= now.keys()
    for key, value in then.items():
        assert now[key] == pytest.approx(value, abs=0.01), key
    assert run.metrics()["format"] == 1


def test_an_evaluation_of_the_first_version_is_reported(run, tmp_path):
    heldout = run.metrics()["heldout"]
    page = write_report([run.path], tmp_path / "report.html").read_text(encoding="utf-8")
    assert "data:image/png" in page and "heldout_000" in page
    for key in ("render_psnr", "albedo_psnr", "roughness_psnr"):
        assert f">{heldout[key]:.2f}</td>" in page


def test_a_run_of_the_first_version_is_evaluated_and_reported_from_its_folder(
    first, unbake, monkeypatch
):
    """The path of its data set starts at the run, not at the working folder."""
    monkeypatch.chdir(first)
    assert unbake("evaluate", "run", "--spp", 1, "--train-views", 0).status == 0
    outcome = unbake("report", "run", "--out", "page.html")
    assert outcome.status == 0, outcome.err


def test_a_run_of_the_first_version_goes_on(first, run, unbake):
    settings = run.settings()
    outcome = unbake("fit", first / "data", "--out", run.path, "--resume", "--steps", 64)
    assert outcome.status == 0, outcome.err
    assert "going on after step 60" in outcome.out
    assert [line["step"] for line in run.log()][-1] == 64
    assert load_run(run.path).progress.step == 64
    assert run.settings().steps == 64 and run.settings().pixels == settings.pixels
    assert json.loads(run.origin_file.read_text())["format"] == 2  # as this version writes it


def test_samples_of_both_passes_count_in_runs_of_the_first_version(first, run, unbake):
    """Its checkpoints count those of one pass."""
    assert load_run(run.path).progress.samples == 60 * 32 * 4
    text = run.config_file.read_text()
    run.config_file.write_text(text.replace('estimator = "auto"', 'estimator = "two-pass"'))
    samples = 2 * 60 * 32 * 4
    assert load_run(run.path).progress.samples == samples
    assert evaluate(run.path, EVALUATED, tell=lambda line: None)["samples"] == samples
    outcome = unbake("fit", first / "data", "--out", run.path, "--resume", "--steps", 64)
    assert outcome.status == 0, outcome.err
    assert load_run(run.path).progress.samples == samples + 4 * 2 * 32 * 4


def test_the_command_for_a_run_whose_data_are_gone_is_quoted(first):
    shutil.rmtree(first / "data")
    run = (first / "run").rename(first / "my run")
    with pytest.raises(UserError, match=rf"unbake fit DATA --out '{run}' --resume$"):
        load_run(run)


def test_settings_of_the_first_version_are_told_beside_new_ones(run, tmp_path):
    new = RunFolder(tmp_path / "new")
    new.write_settings(run.settings())
    assert new.config_file.read_text() != run.config_file.read_text()
    told, again = run.settings_table(), new.settings_table()
    assert told["materials"]["albedo"]["neural"]["width"] == 8
    assert told["regularization"].items() <= again["regularization"].items()
    assert set(again["regularization"]) - set(told["regularization"]) == {"albedo_radius"}
    for quantity, forms in again["materials"].items():
        for form, settings in forms.items():
            assert_told_alike(told["materials"][quantity][form], settings)


def assert_told_alike(old, new):
    """What version 0.1 wrote has the names and values of today, which knows more settings."""
    for name, value in old.items():
        if isinstance(value, dict):
            assert_told_alike(value, new[name])
        else:
            assert new[name] == value, name


def test_newer_settings_are_refused_by_a_fit_and_a_report(run, tmp_path):
    run.config_file.write_text("format = 9\n" + run.config_file.read_text())
    said = NEWER.format(file="config.toml: format", version=9, known=8)
    for use in (load_run, lambda path: write_report([path], tmp_path / "report.html")):
        with pytest.raises(UserError, match=said):
            use(run.path)


def set_format(file, version):
    file.write_text(json.dumps(json.loads(file.read_text()) | {"format": version}))


NEWER = r"{file}: was written by a newer unbake \(format {version}; .* up to {known}\). Update"


@pytest.mark.parametrize(
    ("name", "known", "use"),
    [
        ("transforms.json", 1, lambda first, run: Dataset.load(first / "data")),
        ("origin.json", 2, lambda first, run: load_run(run.path)),
        ("metrics.json", 1, lambda first, run: write_report([run.path], run.path / "page.html")),
    ],
)
def test_a_newer_file_is_refused_in_one_line_that_says_so(name, known, use, first, run):
    (file,) = first.rglob(name)
    set_format(file, 9)
    with pytest.raises(UserError, match=NEWER.format(file=name, version=9, known=known)) as caught:
        use(first, run)
    assert "\n" not in str(caught.value)
    for wrong in ("1", 0, 1.0, True, None):
        set_format(file, wrong)
        with pytest.raises(UserError, match=rf"{name}: 'format' is .*, not a positive whole"):
            use(first, run)


def test_a_newer_checkpoint_is_refused_rather_than_an_older_one_taken(run, monkeypatch):
    recovered = load_run(run.path)
    state = initial_state(recovered.problem)
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "FORMAT", 3)
        checkpoint.save_checkpoint(run, state, checkpoint.Progress(61))
    said = NEWER.format(file="step-000000061", version=3, known=2)
    with pytest.raises(UserError, match=said):
        load_run(run.path)
    assert len(run.written_checkpoints()) == 2


def test_what_is_written_names_its_format(cornell):
    assert DataFolder(cornell).read_transforms()["format"] == 1
