"""Settings: TOML gives back what was written, and every mistake is named."""

import dataclasses
import json
import os
import re
import subprocess
import sys
import typing
from pathlib import Path

import numpy as np
import pytest
from support import of_format

from unbake.acquisition.settings import CaptureSettings, DegradeSettings
from unbake.config import (
    BitmapConfig,
    DenseGridConfig,
    FitConfig,
    GridConfig,
    LightingConfig,
    NetworkConfig,
    PathConfig,
    PresetName,
    TransportConfig,
    from_toml,
    preset,
    read_toml,
    to_toml,
)
from unbake.config.light import LightConfig
from unbake.config.migration import FORMAT, as_before, migrated
from unbake.errors import UserError
from unbake.evaluation.settings import EvaluationSettings, RenderSettings
from unbake.fields.settings import LEAK, PieceConfig
from unbake.training.run_folder import RunFolder
from unbake.training.schedule import learning_rates

PRESETS = typing.get_args(PresetName)
#: For another process to find the package of this checkout.
PATH = {"PYTHONPATH": str(Path(__file__).parents[1] / "src")}


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
        {"final_learning_rate": 1e-300, "loss_epsilon": 1e20, "seconds": 1 / 3},
        {"materials": {"albedo": {"neural": NetworkConfig(GridConfig(1, 4, 12, 7, 1.05), 3, 5)}}},
        {"materials": {"roughness": {"bitmap": BitmapConfig(9, 1e-300)}}},
        {"radiance": {"grid": DenseGridConfig(7)}, "radiance_representation": "grid"},
        {"quantities": ("roughness",), "representation": "bitmap"},
        {"transport": TransportConfig(0), "estimator": "two-pass"},
        {"estimator": "all-pairs"},
        {"estimator": "split-halves"},
    ],
)
def test_any_settings_survive_toml(changes):
    config = dataclasses.replace(preset("release"), **changes)
    assert from_toml(to_toml(config)) == config


def test_every_field_is_written():
    # What is left open to the method is left out.
    assert not {"warm_up", "final_learning_rate"} & set(to_toml(FitConfig()).split())
    lines = to_toml(FitConfig(warm_up=9, final_learning_rate=0.5)).splitlines()
    for field in dataclasses.fields(FitConfig):
        starts = (f"{field.name} = ", f"[{field.name}]", f"[{field.name}.")
        assert any(line.startswith(starts) for line in lines)


def test_absent_keys_come_from_the_named_preset():
    assert from_toml("") == preset("cpu")
    config = from_toml(
        'preset = "paper"\nsteps = 5\nfinal_learning_rate = 1\n[radiance.neural]\nwidth = 9\n'
    )
    assert (config.steps, config.final_learning_rate) == (5, 1.0)
    assert isinstance(config.final_learning_rate, float)
    network = dataclasses.replace(preset("paper").radiance["neural"], width=9)
    expected = dataclasses.replace(
        preset("paper"), steps=5, final_learning_rate=1.0, radiance={"neural": network}
    )
    assert config == expected


def test_all_pairs_need_samples_that_are_independent():
    """A wavefront that narrows by systematic sampling has two independent halves of them."""
    assert FitConfig(method="prb", estimator="all-pairs").one_pass == "all-pairs"
    message = "^estimator: must be split-halves or two-pass for the method ad-pt, whose samples"
    with pytest.raises(UserError, match=message):
        FitConfig(method="ad-pt", estimator="all-pairs")
    assert FitConfig(method="ad-pt", estimator="split-halves").one_pass == "split-halves"


def test_presets_hold_the_published_values():
    """Sec. 5.3, 5.4, Table 1 (STAIRCASE), and what the public release says beside that."""
    paper, release = preset("paper"), preset("release")
    for config in (paper, release):
        assert (config.steps, config.pixels, config.spp) == (18_000, 2**14, 16)
        assert (config.radiance_samples, config.pixel_sampling) == (16, "one-view-crop")
        assert config.two_passes and config.loss_reference == "photograph"
        assert (config.loss_epsilon, config.final_learning_rate, config.warm_up) == (0.01, 1.0, 0)
        fields = [*config.materials.values(), config.radiance]
        networks = [settings["neural"] for settings in fields]
        assert {n.learning_rate for n in networks} == {5e-4} and {n.width for n in networks} == {
            256
        }
        assert [n.hidden for n in networks] == [1] * (len(fields) - 1) + [3]
        # 128² texels over the sphere: as many around the horizon as an image of 256 x 128 has
        light = config.lighting
        assert (light.resolution, light.learning_rate, light.initial_radiance) == (128, 5e-4, 1.0)
    grids = [config.radiance["neural"].grid for config in (paper, release)]
    sizes = [(g.levels, g.features, g.table_log2, g.base_resolution, g.growth) for g in grids]
    assert sizes == [(16, 2, 17, 2, 2.0), (17, 2, 18, 2, 1.5)]
    assert grids[0].base_resolution * grids[0].growth ** (grids[0].levels - 1) == 2**16

    light = preset("release-lighting")
    assert (light.unknown, light.steps, light.pixels, light.spp) == ("lighting", 600, 256**2, 8)
    rates = learning_rates(light, 0, 0.0), learning_rates(light, 599, 1.0)
    assert rates[0]["environment"] == rates[1]["environment"] == 1e-3


def test_settings_cannot_be_changed_in_place():
    with pytest.raises(dataclasses.FrozenInstanceError):
        FitConfig().steps = 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("steps = ", "not valid TOML"),
        ("steps = 1\nsteps = 2", "not valid TOML"),
        (
            "stepz = 1\npreown = 2",
            "unknown keys stepz, preown. Known keys: steps, precision, .* …$",
        ),
        ("stepz = 1", "stepz: unknown key. Known keys: steps, .* …$"),
        (f"{'x' * 5000} = 1", "x+…x+: unknown key. Known keys: .{100,250} …$"),
        (
            f"[radiance.neural.grid]\nlevels = {10**400}",
            r"radiance.neural.grid.levels: must be \d+ or less, not 1000",
        ),
        (
            "[radiance.neural]\nwidht = 1",
            r"radiance.neural.widht: unknown key. Known keys: grid, width",
        ),
        ("[radiance.neural.grid]\nlevel = 1", r"radiance.neural.grid.level: unknown key"),
        ("[optimizer]\nrate = 1", "optimizer: unknown key"),
        ("radiance = 3", "radiance: must be a table"),
        ("[steps]\na = 1", "steps: must be int, not dict"),
        ("steps = 3.0", "steps: must be int, not float"),
        ("steps = true", "steps: must be int, not bool"),
        ("final_learning_rate = true", "final_learning_rate: must be float, not bool"),
        ('final_learning_rate = "fast"', "final_learning_rate: must be float, not str"),
        ("final_learning_rate = [1]", "final_learning_rate: must be float, not list"),
        ("final_learning_rate = 0", "final_learning_rate: must be positive, not 0.0"),
        ("final_learning_rate = nan", "final_learning_rate: must be a finite number, not nan"),
        ("seconds = inf", "seconds: must be a finite number, not inf"),
        (f"seconds = {10**400}", "seconds: must be float"),
        ("pixels = 0", "pixels: must be 1 or more, not 0"),
        ("steps = -1", "steps: must be 0 or more, not -1"),
        ("pixels = 0", "pixels: must be 1 or more"),
        ("spp = 5", "spp: must be an even number, 2 or more, not 5"),
        ("seed = -1", "seed: must be 0 or more"),
        ("warm_up = -1", "warm_up: must be 0 or more"),
        ("loss_epsilon = 0.0", "loss_epsilon: must be 1e-12 or more, not 0.0"),
        (
            'preset = "fast"',
            "preset: must be one of cpu, paper, release, release-lighting, not 'fast'",
        ),
        (f'preset = "{"fast " * 99}"', "preset: must be one of .{100,150}$"),
        ("preset = 1", "preset: must be one of cpu, paper, release, release-lighting, not 1"),
        ("preset = [1]", "preset: must be one of"),
        ('method = "best"', "method: must be one of ours, no-prior, direct, ad-pt, .*not 'best'"),
        ("[lighting]\ninitial_radiance = -1.0", "lighting.initial_radiance: must be 0 or more"),
        ('pixel_sampling = "crop"', "pixel_sampling: must be one of all-views, one-view-crop"),
        ("[radiance.neural]\nwidth = 0", r"radiance.neural.width: must be 1 or more"),
        ("[radiance.neural]\nhidden = 0", r"radiance.neural.hidden: must be 1 or more"),
        ("[radiance.neural.grid]\nlevels = -1", r"radiance.neural.grid.levels: must be 0 or more"),
        ("[radiance.neural.grid]\nlevels = 30", r"radiance.neural.grid.levels: must be such that"),
        (
            "[radiance.neural.grid]\nfeatures = 3",
            r"radiance.neural.grid.features: must be 2, 4 or 8, not 3",
        ),
        (
            "[radiance.neural.grid]\ntable_log2 = 60",
            r"radiance.neural.grid.table_log2: must be 28 or less, not 60",
        ),
        (
            "[radiance.neural.grid]\nbase_resolution = 0",
            r"radiance.neural.grid.base_resolution: must be 1 or more",
        ),
        ("[radiance.neural.grid]\ngrowth = 0.5", r"radiance.neural.grid.growth: must be 1 or more"),
        (
            "[radiance.neural.grid]\ngrowth = nan",
            r"radiance.neural.grid.growth: must be a finite number",
        ),
        (
            "[radiance.neural.grid]\ngrowth = inf",
            r"radiance.neural.grid.growth: must be a finite number",
        ),
        ("[transport]\nmax_specular = -1", r"transport.max_specular: must be 0 or more"),
    ],
)
def test_a_mistake_is_named_with_its_key(text, message):
    with pytest.raises(UserError, match=f"^here.toml: {message}"):
        from_toml(text, "here.toml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"steps = {10**10}", "steps: must be 1000000000 or less, not 10000000000"),
        (f"pixels = {10**9}", "pixels: must be 67108864 or less"),
        (
            f"spp = {10**9}",
            r"pixels: pixels \* spp must be 67108864 or less, not 1024000000000. "
            "Lower spp to 65536$",
        ),
        (
            "pixels = 60000000\nspp = 8",
            r"pixels: pixels \* spp must be .* Lower pixels \(--batch\) to 8388608$",
        ),
        (f"seed = {1 << 63}", "seed: must be 9223372036854775807 or less"),
        ("seconds = 1e300", "seconds: must be 1000000000 or less"),
        ("final_learning_rate = 1e300", "final_learning_rate: must be 1000.0 or less"),
        ("loss_epsilon = 1e-300", "loss_epsilon: must be 1e-12 or more"),
        ("rate_factors.albedo = inf", "rate_factors.albedo: must be positive and 10000 or less"),
        (f"[path]\nmax_depth = {10**10}", "path.max_depth: must be 10000 or less"),
        (f"[path]\nrr_depth = {10**10}", "path.rr_depth: must be 10000 or less"),
        (f"[transport]\nmax_specular = {10**10}", "transport.max_specular: must be 10000 or less"),
        ("[lighting]\nlearning_rate = inf", "lighting.learning_rate: must be a finite number"),
        ("[lighting]\nlearning_rate = 1e300", "lighting.learning_rate: must be 10.0 or less"),
        ("[lighting]\ninitial_radiance = 1e38", r"lighting.initial_radiance: must be 1e\+20 or l"),
        ("[lighting]\nanchor = inf", "lighting.anchor: must be a finite number"),
        ("[regularization]\nradius = inf", "regularization.radius: must be a finite number"),
        (
            "[radiance.neural]\nlearning_rate = 1e300",
            "radiance.neural.learning_rate: must be 10.0 o",
        ),
        ("[radiance.neural]\nwidth = 1000000000", "radiance.neural.width: must be 1024 or less"),
        ("[radiance.neural]\nhidden = 300", "radiance.neural.hidden: must be 32 or less, not 300"),
        (
            "[radiance.neural.grid]\nlevels = 1000000\ngrowth = 1.0",
            "radiance.neural.grid.levels: must be 32 or less, not 1000000",
        ),
        ("[radiance.triplane]\nhidden = 300", "radiance.triplane.hidden: must be 32 or less"),
        ("[materials.albedo.grid]\ncells = 513", "materials.albedo.grid.cells: must be 512 or le"),
        # All of a table at once
        (
            "stepz = 1\nunknown = 3\n[radiance]\nx = 1",
            "stepz: unknown key.*; unknown: must be .*; radiance.x: unknown key",
        ),
        (
            "steps = -1\npixels = 0\nseconds = nan",
            "seconds: must be a finite number, not nan; steps: must be 0 or more, not -1; "
            "pixels: must be 1 or more, not 0$",
        ),
        # What a method needs
        (
            'method = "ad-pt"\npath.max_depth = 1',
            "path.max_depth: must be 2 or more for the method ad-pt: .*, not 1$",
        ),
        (
            'method = "ad-pt"\npath.max_depth = 9999',
            r"path.max_depth: must be 256 or less for the method ad-pt, .*prb.*, not 9999$",
        ),
    ],
)
def test_what_no_machine_could_do_is_refused(text, message):
    with pytest.raises(UserError, match=f"^here.toml: {message}"):
        from_toml("format = 2\n" + text, "here.toml")


def test_depths_are_those_of_methods_that_follow_paths():
    path = PathConfig(max_depth=1)
    assert dataclasses.replace(FitConfig(), path=path).path == path
    deep = PathConfig(max_depth=9999)
    assert dataclasses.replace(FitConfig(method="prb"), path=deep).path == deep


def test_a_file_that_is_no_text_or_missing_is_named(tmp_path):
    file = tmp_path / "a.toml"
    with pytest.raises(UserError, match=r"a.toml: the file does not exist"):
        read_toml(file)
    file.write_bytes(b"steps = 1 # \xff")
    with pytest.raises(UserError, match=r"a.toml: the file is not UTF-8 text. Repair it"):
        read_toml(file)
    with pytest.raises(UserError, match="cannot be read"):
        read_toml(tmp_path)


# -------------------------------------------------------------------------------- earlier formats


#: Every key of format 1 that has moved, with a value that no preset has.
FORMAT_1 = """
preset = "paper"
learning_rate = 0.5
roughness_learning_rate = 0.25
radiance_learning_rate = 0.125
representation = "grid"
[albedo]
width = 11
[albedo.grid]
levels = 3
[roughness]
hidden = 5
[radiance]
width = 13
[radiance.grid]
features = 4
[grid]
albedo = 5
roughness = 6
radiance = 7
learning_rate = 0.75
roughness_learning_rate = 0.875
radiance_learning_rate = 0.625
[bitmap]
albedo = 8
roughness = 9
learning_rate = 0.375
roughness_learning_rate = 0.3125
[regularisation]
roughness_smoothness = 2.0
"""
FORMAT_2 = """
format = 2
preset = "paper"
representation = "grid"
[materials.albedo]
neural = { width = 11, learning_rate = 0.5, grid = { levels = 3 } }
grid = { cells = 5, learning_rate = 0.75 }
bitmap = { resolution = 8, learning_rate = 0.375 }
[materials.roughness]
neural = { hidden = 5, learning_rate = 0.25 }
grid = { cells = 6, learning_rate = 0.875 }
bitmap = { resolution = 9, learning_rate = 0.3125 }
[radiance]
neural = { width = 13, learning_rate = 0.125, grid = { features = 4 } }
grid = { cells = 7, learning_rate = 0.625 }
[regularization]
roughness_smoothness = 2.0
"""


@pytest.mark.parametrize("number", ["", "format = 1\n"], ids=["without number", "with number"])
def test_settings_of_format_1_mean_the_same_today(number):
    old = from_toml(number + FORMAT_1)
    # What a user gives has the defaults of today, and what a run has those of its time.
    assert old == from_toml(
        FORMAT_2 if number else FORMAT_2.replace("format = 2", f"format = {FORMAT}")
    )
    assert old.materials["albedo"]["neural"] == NetworkConfig(
        dataclasses.replace(preset("paper").materials["albedo"]["neural"].grid, levels=3),
        width=11,
        hidden=1,
        learning_rate=0.5,
        pieces=PieceConfig(across_slivers=not number),
    )
    assert old.radiance["grid"] == DenseGridConfig(7, 0.625)
    assert from_toml(to_toml(old)) == old


def test_keys_that_are_absent_today_are_those_of_the_preset():
    assert from_toml(f"format = {FORMAT}\n") == preset("cpu") != from_toml("format = 2\n")


def test_the_radiance_field_has_no_pieces():
    with pytest.raises(UserError, match=r"radiance\.neural\.pieces\.most.*materials alone"):
        from_toml("[radiance.neural.pieces]\nmost = 64\n")


def test_fields_of_earlier_runs_do_not_leak():
    text = of_format(to_toml(preset("cpu")), 2)
    lines = [line for line in text.splitlines() if not line.startswith("leak = ")]
    found = [from_toml(x).radiance["neural"].leak for x in (text, "\n".join(lines))]
    assert found == [LEAK, 0]
    assert as_before("radiance.neural") == as_before("radiance.triplane") == {"leak": 0}
    assert as_before("radiance.grid") == as_before("radiance") == {}


def test_the_convention_of_earlier_runs_keeps_its_weight():
    for anchor in (0.01, 10.0):
        old = migrated({"format": 7, "lighting": {"anchor": anchor}})["lighting"]
        assert old["final_anchor"] == anchor and old["coarse_gain"] == 1
    new = migrated({"format": FORMAT, "lighting": {"anchor": 10.0}})
    assert new == {"lighting": {"anchor": 10.0}}


def test_earlier_runs_go_by_the_background_where_the_scale_is_open():
    text = to_toml(preset("cpu"))
    lines = [line for line in text.splitlines() if not line.startswith("scale_told_by = ")]
    assert len(lines) < len(text.splitlines())
    old = of_format("\n".join(lines), 4)
    found = [from_toml(x).lighting.scale_told_by for x in (text, "\n".join(lines), old)]
    assert found == ["pixels", "pixels", "background"]


def test_a_setting_that_is_no_more_is_passed_over_in_runs_alone():
    text = of_format(to_toml(preset("cpu")), 2)
    assert "\n[camera]\n" in text
    old = text.replace("\n[camera]\n", "\n[camera]\nsmoothness = 0.25\n")
    assert from_toml(old) == from_toml(text)
    with pytest.raises(UserError, match="smoothness"):
        from_toml("[camera]\nsmoothness = 0.25\n")


def test_a_file_without_a_format_may_have_keys_of_today():
    config = from_toml("learning_rate = 0.5\n[radiance.grid]\ncells = 9\nlearning_rate = 0.25\n")
    assert config.materials["albedo"]["neural"].learning_rate == 0.5
    assert config.radiance["grid"] == DenseGridConfig(9, 0.25)
    assert from_toml("[radiance.grid]\nlevels = 5").radiance["neural"].grid.levels == 5


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "format = 9",
            r"format: was written by a newer unbake \(format 9; .* up to 8\). Update unbake",
        ),
        ("format = true", "format: 'format' is True, not a positive whole number"),
        ("format = 2\nlearning_rate = 1.0", "learning_rate: unknown key"),
        ("[grid]\nalbdo = 1", "grid.albdo: unknown key. Known keys: albedo, roughness, radiance, "),
        ("learning_rate = 1.0\nalbedo = 3", "materials.albedo.neural: must be a table|albedo: "),
        ("[bitmap]\nalbedo = 0", "materials.albedo.bitmap.resolution: must be 1 or more, not 0"),
        ("[roughness]\nwidth = 0", "materials.roughness.neural.width: must be 1 or more, not 0"),
    ],
)
def test_a_mistake_in_an_old_file_is_named(text, message):
    with pytest.raises(UserError, match=f"^here.toml: ({message})"):
        from_toml(text, "here.toml")


# ------------------------------------------------------------------- quantities, representations


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('quantities = ["albedo", "gloss"]', "quantities: no quantity named 'gloss'. There are a"),
        ("quantities = []", "quantities: no quantity named. There are albedo, roughness"),
        ('quantities = ["albedo", "albedo"]', "quantities: a quantity is named twice"),
        ('quantities = "albedo"', "quantities: must be a list, not str"),
        ("quantities = [1]", "quantities: must be str, not int"),
        ("[materials.gloss.neural]\nwidth = 1", "materials.gloss: unknown key. Known keys: albedo"),
        ("[materials.albedo.mesh]\nwidth = 1", "materials.albedo.mesh: unknown key"),
        ("[materials.albedo.bitmap]\ncells = 1", "materials.albedo.bitmap.cells: unknown key"),
        ("[radiance.bitmap]\nresolution = 1", "radiance.bitmap: unknown key. Known keys: neural"),
        ("[radiance.grid]\nlearning_rate = nan", "radiance.grid.learning_rate: must be a finite"),
        (
            'representation = "mesh"',
            "representation: must be one of neural, grid, bitmap, triplane, not 'm",
        ),
        ('radiance_representation = "bitmap"', "radiance_representation: must be one of neural, g"),
        (
            'quantities = ["albedo"]\n[regularization]\nroughness_smoothness = 1.0',
            r"quantities: must be roughness at least, as \[regularization\] says, not 'albedo'",
        ),
    ],
)
def test_a_field_that_there_is_not_is_named(text, message):
    with pytest.raises(UserError, match=f"^here.toml: {message}"):
        from_toml("format = 2\n" + text, "here.toml")


@pytest.mark.parametrize(
    ("kind", "changes", "message"),
    [
        (FitConfig, {"steps": 20.5}, "steps: must be int, not float"),
        (FitConfig, {"steps": True}, "steps: must be int, not bool"),
        (FitConfig, {"steps": "a"}, "steps: must be int, not str"),
        (FitConfig, {"steps": None}, "steps: must be int, not NoneType"),
        (
            FitConfig,
            {"pixels": 100.5, "seed": 1.5},
            "seed: must be int, not float; pixels: must be int, not float",
        ),
        (FitConfig, {"bounces": 1.5, "steps": -1}, "bounces: must be int, not float; steps: must "),
        (FitConfig, {"spp": [4]}, "spp: must be int, not list"),
        (FitConfig, {"seconds": "a"}, "seconds: must be float, not str"),
        (FitConfig, {"warm_up": 1.5}, "warm_up: must be int, not float"),
        (FitConfig, {"unknown": "light"}, "unknown: must be one of auto, materials, lighting, emi"),
        (FitConfig, {"method": 3}, "method: must be str, not int"),
        (FitConfig, {"path": {"max_depth": 3}}, "path: must be PathConfig, not dict"),
        (LightingConfig, {"mean_albedo": "a"}, "mean_albedo: must be float, not str"),
        (GridConfig, {"levels": 2.5}, "levels: must be int, not float"),
        (CaptureSettings, {"views": 1.5}, "views: must be int, not float"),
        (DegradeSettings, {"clip": "all"}, "clip: must be float, not str"),
        (EvaluationSettings, {"truth": 1}, "truth: must be bool, not int"),
        (RenderSettings, {"spp": 2.5}, "spp: must be int, not float"),
        (RenderSettings, {"spp": "a"}, "spp: must be int, not str"),
        (RenderSettings, {"width": 33.5}, "width: must be int, not float"),
        (RenderSettings, {"views": "test"}, "views: must be one of heldout, train, all, not 'tes"),
    ],
)
def test_settings_of_a_wrong_type_are_refused(kind, changes, message):
    with pytest.raises(UserError, match=f"^{message}"):
        kind(**changes)
    with pytest.raises(UserError, match=f"^{message}"):
        dataclasses.replace(kind(), **changes)


def test_numbers_of_numpy_and_whole_numbers_are_numbers():
    config = FitConfig(
        steps=np.int64(20), seed=np.uint8(3), held_aside=np.float32(0.25), seconds=5, warm_up=None
    )
    assert (config.steps, config.seed, config.held_aside, config.seconds) == (20, 3, 0.25, 5)
    assert from_toml(to_toml(config)) == config
    assert json.dumps(dataclasses.asdict(RenderSettings(width=np.int32(7), exposure=1)))
    config = FitConfig(rate_factors={"roughness": np.float32(0.5), "albedo": 2})
    assert from_toml(to_toml(config)) == config
    for wrong in (True, "0.5"):
        with pytest.raises(UserError, match=r"^rate_factors.albedo: must be positive and 10000"):
            FitConfig(rate_factors={"albedo": wrong})


@pytest.mark.parametrize("up", ["+Z", "-Y", "up", "z", "", None])
def test_the_up_axis_of_a_map_is_one_of_six(up):
    with pytest.raises(UserError, match=r"^envmap_up: must be one of \+x, -x, \+y, -y, \+z, -z, n"):
        LightConfig(envmap="sky.exr", envmap_up=up)
    assert LightConfig(envmap="sky.exr", envmap_up="-z").up == (0, 0, -1)


@pytest.mark.parametrize(
    ("key", "wrong", "wanted"),
    [
        *(
            ("quantities", wrong, "a tuple of names")
            for wrong in ("albedo", 3.5, None, [["albedo"]], (3,))
        ),
        *(("rate_factors", wrong, "a dictionary") for wrong in ("a", 3.5, None, [1])),
        *(("materials", wrong, "a dictionary") for wrong in ("a", 3.5, None, [1])),
        *(("radiance", wrong, "a dictionary") for wrong in ("a", 3.5, None, [1])),
    ],
)
def test_settings_of_another_kind_are_told(key, wrong, wanted):
    with pytest.raises(UserError, match=f"^{key}: must be {wanted}, not {re.escape(repr(wrong))}"):
        FitConfig(**{key: wrong})


def test_settings_of_one_material_are_a_dictionary():
    with pytest.raises(UserError, match=r"^materials\.albedo: must be a dictionary, not 3"):
        FitConfig(materials={"albedo": 3})


@pytest.mark.parametrize("key", ["envmap", "lights"])
@pytest.mark.parametrize("wrong", [3.5, [1], {"a": 1}])
def test_a_light_is_the_path_of_a_file(key, wrong):
    with pytest.raises(UserError, match=f"^{key}: must be the path of a file, not "):
        LightConfig(**{key: wrong})


def test_quantities_stand_in_the_order_of_the_table():
    config = FitConfig(quantities=("roughness", "albedo"))
    assert config.quantities == ("albedo", "roughness") == tuple(config.material_settings)


def test_settings_are_read_without_mitsuba():
    code = "import sys, unbake.config; print({'drjit', 'mitsuba'} & set(sys.modules))"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, env=os.environ | PATH
    )
    assert done.stdout.strip() == "set()", done.stderr


@pytest.mark.parametrize(
    "text",
    [
        "steps = " + "[" * 5000 + "]" * 5000,
        "steps = " + "[" * 70 + "]" * 70,
        ".".join(["a"] * 5000) + " = 1",
        "steps = " + "1" * 5000,
    ],
)
def test_toml_that_is_deep_or_endless_is_told_in_one_line(text, tmp_path):
    file = tmp_path / "a.toml"
    file.write_text(text)
    with pytest.raises(UserError, match=r"a\.toml: not valid TOML") as caught:
        read_toml(file)
    assert len(str(caught.value)) < 300


def test_settings_are_not_read_if_they_are_far_longer_than_settings_are(tmp_path):
    run = RunFolder(tmp_path)
    run.config_file.write_text(".".join(["a"] * 50_000) + " = 1")
    for read in (run.settings, run.settings_table):
        with pytest.raises(
            UserError, match=r"config\.toml: has 100003 characters, settings at most"
        ):
            read()
    run.config_file.write_text("steps = " + "[" * 5000 + "]" * 5000)
    with pytest.raises(UserError, match=r"config\.toml: not valid TOML"):
        run.settings_table()


def test_a_pipe_is_no_settings_file(tmp_path):
    os.mkfifo(tmp_path / "a.toml")
    with pytest.raises(UserError, match="it is a pipe or a device"):
        read_toml(tmp_path / "a.toml")
