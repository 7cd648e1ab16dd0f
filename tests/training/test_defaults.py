"""What a new fit takes from its method, and what a run that was started keeps."""

import json
from dataclasses import replace

import pytest
from support import TINY_FIT

from unbake.comparison.method_variant import MethodVariant
from unbake.config import FitConfig, PathConfig, from_toml, preset, read_toml, to_toml
from unbake.config import method_defaults as module
from unbake.config.fit import GAIN_OF_ROOMS, UNKNOWNS
from unbake.config.method_defaults import MethodDefaults
from unbake.dataset.scene_kind import scene_kind
from unbake.dataset.views import Dataset
from unbake.training.defaults import with_method_defaults
from unbake.training.fresh_fit import begin_fit
from unbake.training.run_folder import RunFolder
from unbake.training.schedule import learning_rates
from unbake.transport.methods import METHODS
from unbake.transport.objective import has_radiance

TABLE = {
    "prb": {
        "room": MethodDefaults({"roughness": 4.0, "albedo": 2.0}, "split-halves"),
        "object": MethodDefaults({"roughness": 3.0}, "two-pass"),
    },
    "direct": {"room": MethodDefaults({"albedo": 0.5})},
}


@pytest.fixture
def table(monkeypatch):
    monkeypatch.setattr(module, "METHOD_DEFAULTS", TABLE)


def defaults(method, kind="room", **settings):
    return with_method_defaults(FitConfig(method=method, **settings), kind)


def test_the_kind_of_scene_is_told_by_the_background(cornell):
    assert scene_kind("visible") == "room" and scene_kind("hidden") == "object"
    assert Dataset.load(cornell).kind == "room"


@pytest.mark.parametrize("method", METHODS)
def test_only_methods_with_a_radiance_field_warm_up(method, cornell):
    """Without L_θ there is nothing to wait for: the first step has the whole rate."""
    config = replace(TINY_FIT, method=method, warm_up=None)
    fit = begin_fit(Dataset.load(cornell), config)
    assert (fit.problem.radiance is not None) == has_radiance(config.chosen_method)
    first, later = (learning_rates(fit.config, step, 0.0) for step in (0, 500))
    share = 1 / 101 if fit.problem.radiance is not None else 1.0
    for name in ("albedo", "roughness"):
        assert first[name] == pytest.approx(share * later[name])


def test_a_fit_without_a_radiance_field_logs_its_whole_rate(unbake, cornell, tiny, tmp_path):
    settings = tmp_path / "warm.toml"
    settings.write_text(tiny.read_text().replace("warm_up = 0\n", ""))
    rates = {}
    for method in ("direct", "no-prior"):
        run = tmp_path / method
        words = ("--out", run, "--settings", settings, "--method", method, "--steps", 1)
        assert unbake("fit", cornell, *words).status == 0
        rates[method] = json.loads((run / "log.jsonl").read_text().splitlines()[0])["learning_rate"]
        assert read_toml(run / "config.toml").warm_up == (100 if method == "no-prior" else 0)
    assert rates["direct"] == pytest.approx(101 * rates["no-prior"], rel=1e-3)


def test_a_method_has_the_rates_that_were_found_for_it(table, monkeypatch):
    found = defaults("prb")
    assert {name: found.rate_factors[name] for name in ("albedo", "roughness")} == {
        "albedo": 2.0,
        "roughness": 4.0,
    }
    # All are numbers from now on, and a second time nothing changes.
    assert set(found.rate_factors) == set(UNKNOWNS)
    assert found.rate_factors["environment"] == 1.0
    assert with_method_defaults(found, "object") == found
    assert found.estimator == "split-halves"
    assert defaults("prb", "object").estimator == "two-pass"
    assert defaults("prb", "object").rate_factors["albedo"] == 1.0
    assert defaults("direct").estimator == defaults("ours").estimator == "all-pairs"
    # Of the same paths it estimates the same gradient.
    assert defaults("ad-pt").rate_factors == found.rate_factors
    assert defaults("ad-pt").estimator == "split-halves"
    # Only its halves are independent.
    pairs = {"prb": {"room": MethodDefaults(estimator="all-pairs")}}
    monkeypatch.setattr(module, "METHOD_DEFAULTS", pairs)
    assert (defaults("prb").estimator, defaults("ad-pt").estimator) == ("all-pairs", "split-halves")
    monkeypatch.setattr(module, "METHOD_DEFAULTS", TABLE)
    assert set(defaults("ours").rate_factors.values()) == {1.0}


def test_objects_have_two_bounces_before_the_radiance_field_and_rooms_one():
    for method in ("ours", "no-prior"):
        assert defaults(method).bounces == 1 and defaults(method, "object").bounces == 2
    # Those without a radiance field, or of the paper's ablation, have what they are by name.
    for method in ("direct", "with-stop-gradient", "prb"):
        assert defaults(method, "object").bounces == 1
    assert defaults("ours", "object", bounces=1).bounces == 1
    for name in ("paper", "release", "release-lighting"):
        assert with_method_defaults(preset(name), "object").bounces == 1
    # Settings of a run that was started have a number; another method has its own again.
    started = defaults("direct", "object")
    other = with_method_defaults(MethodVariant.of("ours").settings(started), "object")
    assert other.bounces == 2


def test_rooms_are_planned_brighter_than_they_begin_and_objects_as_they_are():
    assert defaults("ad-pt").path.planned_gain == GAIN_OF_ROOMS > 1
    assert defaults("ad-pt", "object").path.planned_gain == 1
    assert defaults("ad-pt", path=PathConfig(planned_gain=2.5)).path.planned_gain == 2.5


def test_what_a_user_says_stays(table):
    found = defaults("prb", rate_factors={"roughness": 1.5}, estimator="two-pass")
    assert found.rate_factors["roughness"] == 1.5 and found.rate_factors["albedo"] == 2.0
    assert found.estimator == "two-pass"
    # The table is of the preset cpu; the others are as they were published.
    for name in ("paper", "release"):
        published = with_method_defaults(replace(preset(name), method="prb"), "room")
        assert set(published.rate_factors.values()) == {1.0}
        assert published.estimator == "two-pass"


def test_a_method_has_the_schedule_that_was_found_or_given(monkeypatch):
    """A warm-up that a user asks for is one, for methods without L_θ too."""
    slow = MethodDefaults(final_learning_rate=0.3, warm_up=30)
    monkeypatch.setattr(module, "METHOD_DEFAULTS", {"prb": {"room": slow}})

    def schedule(method, **settings):
        found = defaults(method, **settings)
        return found.final_learning_rate, found.warm_up

    assert schedule("prb") == schedule("ad-pt") == (0.3, 30)
    assert schedule("direct") == (0.05, 0) and schedule("ours") == (0.05, 100)
    assert schedule("prb", warm_up=7, final_learning_rate=1.0) == (1.0, 7)
    assert schedule("direct", warm_up=7) == (0.05, 7)
    # Another method has its own again.
    ours = MethodVariant("ours").settings(defaults("prb"))
    assert (ours.final_learning_rate, ours.warm_up) == (None, None)
    published = replace(preset("paper"), method="prb")
    assert with_method_defaults(published, "room").final_learning_rate == 1.0


def test_factors_that_were_found_with_networks_are_for_networks(table, monkeypatch):
    """Other representations keep their own rates; an environment map has none of them."""
    lit = {"room": MethodDefaults({"albedo": 2.0, "environment": 3.0}, "split-halves")}
    monkeypatch.setattr(module, "METHOD_DEFAULTS", TABLE | {"prb": lit})
    for form in ("grid", "triplane", "bitmap"):
        found = defaults("prb", representation=form)
        assert found.rate_factors["albedo"] == found.rate_factors["roughness"] == 1.0
        assert found.rate_factors["environment"] == 3.0 and found.estimator == "split-halves"
        given = defaults("prb", representation=form, rate_factors={"albedo": 1.5})
        assert given.rate_factors["albedo"] == 1.5
    assert defaults("prb", representation="neural").rate_factors["albedo"] == 2.0


def test_each_method_of_a_comparison_has_its_own_rates(table):
    shared = defaults("prb")
    own = with_method_defaults(MethodVariant("direct").settings(shared), "room")
    assert own.rate_factors["albedo"] == 0.5 and own.rate_factors["roughness"] == 1.0
    assert MethodVariant("prb").settings(shared) == shared


def test_settings_files_have_factors_of_rates():
    config = from_toml("[rate_factors]\nroughness = 4\n")
    assert config.rate_factors["roughness"] == 4.0 and config.rate_factors["albedo"] is None
    assert from_toml(to_toml(config)) == config
    found = defaults("prb")
    assert from_toml(to_toml(found)) == found


def test_a_run_goes_on_with_the_rates_that_it_was_started_with(
    table, unbake, cornell, tiny, tmp_path, monkeypatch
):
    folder = RunFolder(tmp_path / "run")
    words = ("fit", cornell, "--out", folder.path)
    start = ("--settings", tiny, "--method", "direct", "--steps", 2)
    assert unbake(*words, *start).status == 0
    assert folder.settings().rate_factors["albedo"] == 0.5
    monkeypatch.setattr(module, "METHOD_DEFAULTS", {})
    assert unbake(*words, "--resume", "--steps", 4).status == 0
    assert folder.settings().rate_factors["albedo"] == 0.5
    # Albedo is the unknown whose rate is logged.
    rate = folder.settings().material_settings["albedo"].learning_rate
    logged = [line["learning_rate"] for line in folder.log() if "validation" not in line]
    assert logged == pytest.approx([0.5 * rate * 0.05**0.5, 0.5 * rate * 0.05**0.75], rel=1e-4)


@pytest.mark.parametrize("estimator", ["auto", "split-halves"])
def test_a_run_of_an_earlier_version_goes_on_as_it_was(
    table, unbake, cornell, tiny, tmp_path, estimator
):
    """Its settings have no factors, a warm-up whatever the method, and errors of split halves."""
    folder = RunFolder(tmp_path / "run")
    words = ("fit", cornell, "--out", folder.path)
    start = ("--settings", tiny, "--method", "direct", "--steps", 1)
    assert unbake(*words, *start).status == 0
    text = folder.config_file.read_text()
    before, _, after = text.partition("[rate_factors]\n")
    after = after[after.index("[") :]
    old = (before + after).replace("warm_up = 0", "warm_up = 9")
    old = old.replace('estimator = "all-pairs"', f'estimator = "{estimator}"')
    folder.config_file.write_text(old)
    assert unbake(*words, "--resume", "--steps", 2).status == 0
    config = folder.settings()
    assert config.warm_up == 9 and config.estimator == estimator
    assert config.chosen_estimator == "split-halves"
    assert set(config.rate_factors.values()) == {None}
    rate = config.material_settings["albedo"].learning_rate
    last = [line["learning_rate"] for line in folder.log() if "validation" not in line][-1]
    assert last == pytest.approx(0.2 * rate * 0.05**0.5, rel=1e-4)


def test_settings_of_a_started_run_do_not_leak_into_another_method(
    table, unbake, cornell, tiny, tmp_path
):
    """The rates, the estimator and the warm-up of a run's method are not those of another one."""
    for method in ("prb", "ours"):
        words = ("--out", tmp_path / method, "--settings", tiny, "--method", method, "--steps", 0)
        assert unbake("fit", cornell, *words).status == 0
    of_prb, of_ours = (RunFolder(tmp_path / name).settings() for name in ("prb", "ours"))
    assert of_prb.warm_up == 0 and of_prb.rate_factors["roughness"] == 4.0
    ours = MethodVariant("ours").settings(of_prb)
    assert ours.estimator == "auto" and ours.warm_up == FitConfig().warm_up
    assert set(ours.rate_factors.values()) == {None}
    prb = MethodVariant("prb").settings(of_ours)
    assert with_method_defaults(prb, "object").estimator == "two-pass"
    assert with_method_defaults(prb, "room").rate_factors["roughness"] == 4.0
    # The command line changes the method in the same way.
    words = ("--settings", RunFolder(tmp_path / "prb").config_file, "--method", "ours")
    assert unbake("fit", cornell, "--out", tmp_path / "again", *words, "--steps", 0).status == 0
    again = RunFolder(tmp_path / "again").settings()
    assert again.rate_factors == of_ours.rate_factors and again.estimator == "all-pairs"


def test_factors_that_a_user_gives_are_those_of_all_methods(table):
    shared = from_toml("[rate_factors]\nroughness = 1.5\n")
    for method in ("direct", "prb", "ours"):
        found = with_method_defaults(MethodVariant(method).settings(shared), "room")
        assert found.rate_factors["roughness"] == 1.5
    assert (
        with_method_defaults(MethodVariant("prb").settings(shared), "room").rate_factors["albedo"]
        == 2.0
    )


def test_the_prior_of_an_earlier_version_is_the_squared_one(unbake, cornell, tiny, tmp_path):
    folder = RunFolder(tmp_path / "run")
    words = ("--settings", tiny, "--method", "with-prior", "--steps", 0)
    assert unbake("fit", cornell, "--out", folder.path, *words).status == 0
    assert folder.settings().method == "with-prior"
    before, _, after = folder.config_file.read_text().partition("[rate_factors]\n")
    folder.config_file.write_text(before + after[after.index("[") :])
    assert folder.settings().method == "with-biased-prior"
