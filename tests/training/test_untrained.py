"""Before the first step: all methods start from the same fields, which favour no answer."""

import io
from dataclasses import replace

import numpy as np
import pytest
from rich.console import Console
from safetensors.numpy import load_file
from support import built_in_cameras, pixel_rays, tiny_fields

from unbake.config import FitConfig, read_toml
from unbake.fields.registry import representations
from unbake.quantities import QUANTITIES
from unbake.training.loop import fit
from unbake.training.problem import make_problem
from unbake.training.run_folder import RunFolder
from unbake.training.state import initial_state
from unbake.transport.methods import METHODS


def start(scene, config: FitConfig) -> dict[str, np.ndarray]:
    """The parameters φ before the first step, by name."""
    problem = make_problem(scene, "visible", config, 0.3)
    return {name: np.array(value) for name, value in initial_state(problem).phi.items()}


@pytest.mark.parametrize("representation", representations())
def test_all_methods_start_from_the_same_fields(representation, built_in):
    shared = replace(tiny_fields(representation), unknown="materials+lighting", seed=3)
    scene = built_in("still")
    first = start(scene, replace(shared, method="ours"))
    assert {name.partition(".")[0] for name in first} == {"albedo", "roughness", "environment"}
    for method in METHODS:
        found = start(scene, replace(shared, method=method))
        assert found.keys() == first.keys()
        for name, value in found.items():
            assert np.array_equal(value, first[name]), (method, name)
    other = start(scene, replace(shared, method="prb", seed=4))
    same = [np.array_equal(other[name], value) for name, value in first.items()]
    # Grids and bitmaps are constant at first, and no seed is needed.
    assert all(same) == (representation in ("grid", "bitmap"))


@pytest.mark.parametrize("representation", representations())
def test_untrained_materials_have_the_neutral_values_of_the_table(representation, built_in):
    config = replace(tiny_fields(representation), quantities=tuple(QUANTITIES))
    problem = make_problem(built_in("still"), "visible", config, 0.3)
    problem.assign(problem.parameters())
    si = problem.scene_view.scene.ray_intersect(pixel_rays(built_in_cameras("still", 16), 1, 0))
    seen = problem.materials.evaluate(si, si.is_valid())
    for name, value in seen.items():
        found = np.array(value)[..., np.array(si.is_valid())]
        assert found.size > 50
        np.testing.assert_allclose(found, QUANTITIES[name].initial, atol=0.03)


def test_initial_values_favour_no_answer():
    for name, row in QUANTITIES.items():
        middle = (row.lower + row.upper) / 2
        # Most surfaces are no metals, and none is half a metal.
        assert row.initial == pytest.approx(0.1 if name == "metallic" else middle)


def test_a_fit_of_no_steps_has_untrained_fields(unbake, cornell, tiny, tmp_path):
    run = RunFolder(tmp_path / "run")
    words = ("fit", cornell, "--out", run.path, "--settings", tiny, "--method", "ours")
    outcome = unbake(*words, "--steps", 0)
    assert outcome.status == 0 and outcome.err == ""
    assert "nothing was learned: the fields are untrained; next: unbake evaluate" in outcome.out
    (checkpoint,) = run.written_checkpoints()
    assert checkpoint == run.checkpoint(0) and run.preview(0).is_file()
    config = run.settings()
    assert config.steps == 0
    expected = start(cornell / "scene" / "scene.xml", config)
    stored = load_file(checkpoint / "state.safetensors")
    for name, value in expected.items():
        assert np.array_equal(stored[f"phi.{name}"], value), name

    outcome = unbake("evaluate", run.path, "--spp", 2)
    assert outcome.status == 0 and "untrained: after 0 steps" in outcome.out
    metrics = run.metrics()
    assert (metrics["steps"], metrics["samples"], metrics["seconds"]) == (0, 0, 0)
    grey = metrics["heldout"]["albedo_psnr"]
    assert 3 < grey < 20
    page = tmp_path / "report.html"
    assert unbake("report", run.path, "--out", page).status == 0
    assert '<td class="method">untrained' in page.read_text()

    # It goes on like any other.
    assert unbake("fit", cornell, "--out", run.path, "--resume", "--steps", 2).status == 0
    assert [line["step"] for line in run.log() if "validation" not in line] == [2]
    assert run.settings().steps == 2


def test_a_fit_tells_what_it_does_before_its_first_step_where_that_takes_long(
    cornell, tiny, tmp_path, clock
):
    config = replace(read_toml(tiny), steps=0)
    said = {}
    for name, step in (("fast", 0.0), ("slow", 60.0)):
        clock.step = step
        console = Console(file=io.StringIO(), width=200)
        fit(cornell, tmp_path / name, config, console=console)
        said[name] = console.file.getvalue().splitlines()
    doing = [
        "choosing the sizes of fields",
        "reading the files of the data set",
        "reading photographs",
        "decoding photographs: 1 of 2",
        "making the scene",
        "checking the data",
        "preparing the first step, for which kernels are compiled",
    ]
    assert [line for line in said["slow"] if line in doing] == doing
    assert not set(said["fast"]) & set(doing)
