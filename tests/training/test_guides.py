"""Roughness has a guide in rooms, where the settings do not say."""

from dataclasses import replace

import pytest

from unbake.config import FitConfig, from_toml, to_toml
from unbake.config.presets import preset
from unbake.training.guides import LEVELS, with_guides


def levels(config):
    return {name: forms["neural"].guide.levels for name, forms in config.materials.items()}


def test_rooms_have_a_guide_of_roughness_and_objects_have_none():
    assert levels(with_guides(FitConfig(), "room")) == {
        "albedo": 0,
        "roughness": LEVELS,
        "metallic": 0,
    }
    assert set(levels(with_guides(FitConfig(), "object")).values()) == {0}
    assert with_guides(FitConfig(), "room").radiance["neural"].guide.levels == 0


@pytest.mark.parametrize("name", ["paper", "release"])
def test_presets_of_the_paper_have_none(name):
    assert set(levels(with_guides(preset(name), "room")).values()) == {0}


def test_without_albedo_there_is_none():
    config = replace(FitConfig(), quantities=("roughness",))
    assert set(levels(with_guides(config, "room")).values()) == {0}


def test_what_a_user_says_stays_and_a_run_keeps_its_numbers():
    given = from_toml("[materials.roughness.neural.guide]\nlevels = 2\n")
    for kind in ("room", "object"):
        chosen = with_guides(given, kind)
        assert levels(chosen)["roughness"] == 2
        assert from_toml(to_toml(chosen)) == chosen
    none = with_guides(from_toml("materials.roughness.neural.guide.levels = 0"), "room")
    assert levels(none)["roughness"] == 0


def test_settings_that_leave_it_open_survive_toml():
    assert from_toml(to_toml(FitConfig())) == FitConfig()
    assert levels(FitConfig())["roughness"] is None
