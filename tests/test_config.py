"""Settings: TOML gives back what was written, and every mistake is named."""

import dataclasses
import typing

import pytest

from unbake.config import (
    FitConfig,
    GridConfig,
    NetworkConfig,
    PresetName,
    TransportConfig,
    from_toml,
    preset,
    read_toml,
    to_toml,
)
from unbake.errors import UserError

PRESETS = typing.get_args(PresetName)


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_survives_toml(name):
    config = preset(name)
    assert config.preset == name
    assert from_toml(to_toml(config)) == config
    assert from_toml(f'preset = "{name}"') == config


@pytest.mark.parametrize(
    "changes",
    [
        {"seed": 2**40, "steps": 1, "spp": 2, "method": "direct"},
        {"learning_rate": 1e-300, "loss_epsilon": 1e20, "seconds": 1 / 3},
        {"albedo": NetworkConfig(GridConfig(1, 4, 12, 7, 1.05), 3, 5)},
        {"transport": TransportConfig(0), "estimator": "two-pass"},
    ],
)
def test_any_settings_survive_toml(changes):
    config = dataclasses.replace(preset("release"), **changes)
    assert from_toml(to_toml(config)) == config


def test_every_field_is_written():
    lines = to_toml(FitConfig()).splitlines()
    for field in dataclasses.fields(FitConfig):
        assert any(line.startswith((f"{field.name} = ", f"[{field.name}]")) for line in lines)


def test_absent_keys_come_from_the_named_preset():
    assert from_toml("") == preset("cpu")
    config = from_toml('preset = "paper"\nsteps = 5\nlearning_rate = 1\n[radiance]\nwidth = 9\n')
    assert (config.steps, config.learning_rate, config.radiance.width) == (5, 1.0, 9)
    assert isinstance(config.learning_rate, float)
    expected = dataclasses.replace(
        preset("paper"),
        steps=5,
        learning_rate=1.0,
        radiance=dataclasses.replace(preset("paper").radiance, width=9),
    )
    assert config == expected


def test_settings_cannot_be_changed_in_place():
    with pytest.raises(dataclasses.FrozenInstanceError):
        FitConfig().steps = 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("steps = ", "not valid TOML"),
        ("steps = 1\nsteps = 2", "not valid TOML"),
        ("stepz = 1", "stepz: unknown key. Known keys: .*steps"),
        ("[radiance]\nwidht = 1", r"radiance.widht: unknown key. Known keys: grid, width"),
        ("[radiance.grid]\nlevel = 1", r"radiance.grid.level: unknown key"),
        ("[optimizer]\nrate = 1", "optimizer: unknown key"),
        ("radiance = 3", "radiance: must be a table"),
        ("[steps]\na = 1", "steps: must be int, not dict"),
        ("steps = 3.0", "steps: must be int, not float"),
        ("steps = true", "steps: must be int, not bool"),
        ("learning_rate = true", "learning_rate: must be float, not bool"),
        ('learning_rate = "fast"', "learning_rate: must be float, not str"),
        ("learning_rate = [1]", "learning_rate: must be float, not list"),
        ("learning_rate = 0", "learning_rate: must be positive, not 0.0"),
        ("learning_rate = nan", "learning_rate: must be a finite number, not nan"),
        ("seconds = inf", "seconds: must be a finite number, not inf"),
        (f"seconds = {10**400}", "seconds: must be float"),
        ("steps = 0", "steps: must be 1 or more, not 0"),
        ("steps = -1", "steps: must be 1 or more, not -1"),
        ("pixels = 0", "pixels: must be 1 or more"),
        ("spp = 5", "spp: must be an even number, 2 or more, not 5"),
        ("seed = -1", "seed: must be 0 or more"),
        ("warm_up = -1", "warm_up: must be 0 or more"),
        ("loss_epsilon = 0.0", "loss_epsilon: must be positive"),
        ('preset = "fast"', "preset: must be one of cpu, paper, release, not 'fast'"),
        ("preset = 1", "preset: must be one of cpu, paper, release, not 1"),
        ("preset = [1]", "preset: must be one of"),
        ('method = "best"', "method: must be one of ours, no-prior, direct, ad-pt, .*not 'best'"),
        ("[radiance]\nwidth = 0", r"radiance.width: must be 1 or more"),
        ("[radiance]\nhidden = 0", r"radiance.hidden: must be 1 or more"),
        ("[radiance.grid]\nlevels = 0", r"radiance.grid.levels: must be 1 or more"),
        ("[radiance.grid]\nlevels = 99", r"radiance.grid.levels: must be such that"),
        ("[radiance.grid]\nfeatures = 3", r"radiance.grid.features: must be 2, 4 or 8, not 3"),
        ("[radiance.grid]\ntable_log2 = 60", r"radiance.grid.table_log2: must be 4 to 28"),
        (
            "[radiance.grid]\nbase_resolution = 0",
            r"radiance.grid.base_resolution: must be 1 or more",
        ),
        ("[radiance.grid]\ngrowth = 0.5", r"radiance.grid.growth: must be 1 or more"),
        ("[radiance.grid]\ngrowth = nan", r"radiance.grid.growth: must be 1 or more"),
        ("[radiance.grid]\ngrowth = inf", r"radiance.grid.levels: must be such that"),
        ("[transport]\nmax_specular = -1", r"transport.max_specular: must be 0 or more"),
    ],
)
def test_a_mistake_is_named_with_its_key(text, message):
    with pytest.raises(UserError, match=f"^here.toml: {message}"):
        from_toml(text, "here.toml")


def test_a_file_that_is_no_text_or_missing_is_named(tmp_path):
    file = tmp_path / "a.toml"
    with pytest.raises(UserError, match=r"a.toml: cannot be read \(No such file"):
        read_toml(file)
    file.write_bytes(b"steps = 1 # \xff")
    with pytest.raises(UserError, match=r"a.toml: is not UTF-8 text. Save it as UTF-8"):
        read_toml(file)
    with pytest.raises(UserError, match="cannot be read"):
        read_toml(tmp_path)
