"""Methods that follow paths get the depth that the light of a data set needs."""

import json
import re
import shutil

import pytest

from unbake.config import FitConfig, PathConfig, read_toml
from unbake.dataset.views import Dataset
from unbake.errors import UserError
from unbake.training.fresh_fit import begin_fit
from unbake.training.path_depth import told_depth, with_path_depth

#: Light of which paths of depth 15 carry 95 %, and of depth 17 99 %.
BRIGHT = [0, *([0.5] * 13), 0.95, 0.989, 0.99, 1]


@pytest.fixture
def data(cornell, tmp_path):
    """A copy of a data set whose light is known: `data([0, 0.5, 0.98, 1])`; None: unknown."""
    folder = tmp_path / "data"
    shutil.copytree(cornell, folder)
    file = folder / "transforms.json"
    content = json.loads(file.read_text())

    def tell(shares):
        content.pop("light_by_depth", None)
        if shares is not None:
            content["light_by_depth"] = shares
        file.write_text(json.dumps(content))
        return folder

    return tell


def test_a_captured_data_set_tells_the_light_of_its_paths(cornell):
    dataset = Dataset.load(cornell)
    light = dataset.light_by_depth
    assert json.loads((cornell / "transforms.json").read_text())["light_by_depth"] == list(light)
    # Rendered with paths of depth 6.
    assert light[0] == 0 and 0.5 < light[1] < light[2] and light[-1] == 1 and len(light) <= 6
    assert dataset.depth_of_light(0.99) == next(d for d in range(1, 7) if light[d - 1] >= 0.99)
    assert dataset.light_of_depth(2) == light[1] and dataset.light_of_depth(99) == 1


def test_the_depth_is_that_of_99_percent_of_the_light(data):
    dataset = Dataset.load(data(BRIGHT))
    config = with_path_depth(FitConfig(method="prb"), dataset)
    assert config.path == PathConfig(max_depth=17)
    told = "paths end at depth 17 and carry 99.0 % of the light (depth 15: 95.0 %)"
    assert told_depth(config, dataset) == told


def test_the_depth_is_not_less_than_that_of_the_paper(data):
    dataset = Dataset.load(data([0, 0.5, 0.991, 0.9991, 1]))
    config = with_path_depth(FitConfig(method="prb"), dataset)
    assert dataset.depth_of_light(0.99) == 3 and config.path == PathConfig(max_depth=15)
    assert told_depth(config, dataset) == "paths end at depth 15 and carry 100.0 % of the light"


def test_an_explicit_depth_is_kept(data):
    dataset = Dataset.load(data([0, 0.5, 0.9, 1]))
    config = FitConfig(method="prb", path=PathConfig(max_depth=2))
    assert with_path_depth(config, dataset) is config
    told = told_depth(config, dataset)
    assert "depth 2 and carry 50.0 % of the light; path.max_depth = 0 chooses" in told


def test_without_word_from_the_data_set_it_is_15(data):
    dataset = Dataset.load(data(None))
    assert dataset.light_by_depth == () and dataset.depth_of_light(0.99) is None
    config = with_path_depth(FitConfig(method="prb"), dataset)
    assert config.path.max_depth == 15 and FitConfig().path.chosen_depth == 15
    assert "does not say how much" in told_depth(config, dataset)


@pytest.mark.parametrize(
    "shares", [0.5, [0, 0.5], [0, 0.6, 0.5, 1], [0, "1"], [True], [-0.5, 1], [0, 1.5]]
)
def test_light_that_cannot_be_is_refused(data, shares):
    with pytest.raises(UserError, match="'light_by_depth' is not a list of shares"):
        Dataset.load(data(shares))


@pytest.mark.parametrize(
    ("shares", "words", "depth"),
    [(BRIGHT, (), 17), (None, (), 15), (BRIGHT, ("--max-depth", 2), 2)],
)
def test_a_fit_tells_and_records_its_depth(unbake, data, tiny, tmp_path, shares, words, depth):
    run = tmp_path / "run"
    done = unbake("fit", data(shares), "--out", run, "--settings", tiny, "--method", "prb",
                  "--representation", "grid", "--steps", 2, *words)  # fmt: skip
    assert done.status == 0, done.err
    assert re.findall(r"paths end at depth (\d+)", done.out) == [str(depth)]
    assert read_toml(run / "config.toml").path.max_depth == depth
    # What the data set says later does not change a run.
    again = unbake("fit", data([0] * 20 + [1]), "--out", run, "--resume", "--steps", 3)
    assert again.status == 0 and f"depth {depth} " in again.out.replace(";", " ")
    assert read_toml(run / "config.toml").path.max_depth == depth


def test_a_method_without_paths_does_not_tell_of_them(unbake, data, tiny, tmp_path):
    done = unbake("fit", data([0, 1]), "--out", tmp_path / "run", "--settings", tiny,
                  "--method", "direct", "--steps", 1)  # fmt: skip
    assert done.status == 0 and "paths end" not in done.out


@pytest.mark.parametrize("method", ["prb", "ad-pt"])
def test_a_step_follows_paths_to_that_depth(data, tiny, method):
    dataset = Dataset.load(data(BRIGHT))
    config = read_toml(tiny)
    fit = begin_fit(dataset, type(config)(**vars(config) | {"method": method}))
    assert fit.step._path_sampler._context.max_depth == 17
