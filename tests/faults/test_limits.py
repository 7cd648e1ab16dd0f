"""Limits of memory: what does not fit is refused before it is made, with what would fit."""

import dataclasses
import os
import re
import resource
import subprocess
import sys
from functools import partial
from math import prod

import pytest
from support import TINY_FIT, tiny_fields

from unbake import memory
from unbake.config import preset, update
from unbake.dataset.views import Dataset
from unbake.errors import UserError
from unbake.fields import radiance
from unbake.fields.field import FieldSpec
from unbake.fields.grid_sizes import USUAL
from unbake.fields.grid_sizes import sized as usual
from unbake.fields.registry import representation, representations
from unbake.quantities import QUANTITIES
from unbake.training.fresh_fit import begin_fit
from unbake.training.limits import require_room

GB = 10**9


@pytest.fixture
def limited(repository, tmp_path):
    """Call the command line in a process whose address space has a limit, in bytes."""

    def call(limit, *words, kind=resource.RLIMIT_AS):
        return subprocess.run(
            [sys.executable, "-m", "unbake", *map(str, words)],
            capture_output=True,
            text=True,
            timeout=300,
            env=os.environ | {"PYTHONPATH": str(repository / "src"), "NO_COLOR": "1"},
            preexec_fn=partial(resource.setrlimit, kind, (limit, limit)),
        )

    return call


@pytest.mark.parametrize("form", representations())
def test_the_size_of_a_field_is_known_before_it_is_made(form):
    config, chosen = tiny_fields(), representation(form)
    wanted = [
        (
            config.materials[name][form],
            FieldSpec(QUANTITIES[name].channels, materials=("a", "b", "c")),
        )
        for name in config.quantities
    ]
    if chosen.radiance:
        spec = FieldSpec(radiance.OUTPUTS, radiance.EXTRA)
        wanted += [(config.radiance[form], spec), (usual(chosen.radiance, USUAL), spec)]
    for settings, spec in wanted:
        parameters = chosen.field(settings, spec).parameters()
        made = sum(prod(value.shape) for value in parameters.values())
        told = settings.numbers(spec.outputs, spec.extra, len(spec.materials))
        assert 0.99 * made - 16 <= told <= 1.1 * made + 500, settings


def sized(config, form, setting, size):
    """Settings with an albedo of another size."""
    table = size
    for key in reversed(("materials", "albedo", form, *setting.split("."))):
        table = {key: table}
    return update(config, table)


@pytest.mark.parametrize(
    ("form", "setting", "size"),
    [
        ("grid", "cells", 512),
        ("bitmap", "resolution", 8192),
        ("triplane", "base_resolution", 4096),
        ("neural", "grid.table_log2", 28),
    ],
)
def test_a_field_that_does_not_fit_is_refused_with_the_size_that_would(
    form, setting, size, monkeypatch
):
    monkeypatch.setattr(memory, "free_bytes", lambda: GB)
    config = dataclasses.replace(preset("cpu"), representation=form)
    config = update(config, {"materials": {"albedo": {"triplane": {"levels": 1}}}})
    with pytest.raises(UserError) as error:
        require_room(sized(config, form, setting, size), materials=3)
    key = f"materials.albedo.{form}"
    told = re.fullmatch(
        rf"{key}: the fields of this fit, with gradients and Adam's moments, need about \S+ GB of "
        rf"memory, 1.0 GB are free. Lower {key}.{setting} from {size} to (\d+) or less",
        str(error.value),
    )
    assert told, str(error.value)
    require_room(sized(config, form, setting, int(told[1])), materials=3)
    with pytest.raises(UserError):
        require_room(sized(config, form, setting, int(told[1]) + 1), materials=3)


def test_a_guide_that_does_not_fit_is_named(monkeypatch):
    monkeypatch.setattr(memory, "free_bytes", lambda: GB)
    config = update(preset("cpu"), {"guide": {"cells": 64}})
    with pytest.raises(UserError, match=r"guide\.cells: .* Lower guide\.cells from 64"):
        require_room(config, materials=3)


def test_a_fit_without_room_for_its_grid_makes_no_run(limited, cornell, tiny, tmp_path):
    """A limit of the process, under which such a grid crashed in native code."""
    file = tmp_path / "large.toml"
    file.write_text(tiny.read_text() + "[materials.albedo.grid]\ncells = 512\n")
    words = ("fit", cornell, "--out", tmp_path / "run", "--representation", "grid", "--steps", 2)
    done = limited(4 * GB, *words, "--settings", file)
    assert done.returncode == 2, done
    assert re.fullmatch(
        r"error: materials.albedo.grid: the fields of this fit, .* need about 7\d.\d GB of memory, "
        r"3.\d GB are free. Lower materials.albedo.grid.cells from 512 to 1\d\d or less\n",
        done.stderr,
    ), done.stderr
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
@pytest.mark.parametrize("limit", [1.5, 1.65, 1.8, 2.0, 2.3])
def test_the_size_that_is_told_does_fit(limit, limited, cornell, tiny, tmp_path):
    file = tmp_path / "large.toml"
    words = ("fit", cornell, "--out", tmp_path / "run", "--representation", "grid", "--steps", 5)
    cells = 256
    for status in (2, 0):
        file.write_text(f"{tiny.read_text()}[materials.albedo.grid]\ncells = {cells}\n")
        done = limited(int(limit * GB), *words, "--settings", file)
        assert done.returncode == status, done
        if status:
            cells = int(re.search(r"to (\d+) or less", done.stderr)[1])
    assert 80 < cells < 200


@pytest.mark.parametrize("method", ["ours", "prb", "ad-pt"])
def test_a_batch_that_does_not_fit_is_refused_with_the_one_that_would(method, cornell, monkeypatch):
    config = dataclasses.replace(TINY_FIT, method=method, pixels=1 << 16)
    fit = begin_fit(Dataset.load(cornell), config)
    forecast = fit.step.forecast(fit.state)
    if forecast is None:
        pytest.skip("the memory of a step cannot be measured here")
    # Measured once: what tests before this one left in Dr.Jit's cache can hide a second reading.
    monkeypatch.setattr(fit.step, "forecast", lambda state: forecast)
    free = int(forecast.bytes(config.pixels) / 2)
    monkeypatch.setattr(memory, "free_bytes", lambda: free)
    monkeypatch.setattr("unbake.training.step.free_bytes", lambda: free)
    with pytest.raises(UserError) as error:
        fit.step.require_memory(fit.state)
    told = re.search(r"Lower --batch from 65536 to (\d+), or --spp", str(error.value))
    assert told and (1 << 13) < int(told[1]) < (1 << 16), str(error.value)
    assert ("or use --method prb" in str(error.value)) == (method == "ad-pt")


def test_a_usual_batch_is_not_measured(cornell, monkeypatch):
    fit = begin_fit(Dataset.load(cornell), TINY_FIT)
    monkeypatch.setattr(fit.step, "forecast", lambda state: pytest.fail("measured"))
    fit.step.require_memory(fit.state)
