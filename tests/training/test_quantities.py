"""A third unknown quantity, from the scene file to the page, and with the truth as its goal."""

import gc
import json
import shutil
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from support import TINY_FIT, assert_only_replayed, built_in_cameras, grey_photographs

from unbake.acquisition.capture import capture
from unbake.acquisition.settings import CaptureSettings
from unbake.config import update
from unbake.dataset.views import Dataset
from unbake.evaluation import yardsticks
from unbake.fields.materials import carry, read_carried
from unbake.imaging.pictures import read_exr
from unbake.quantities import QUANTITIES
from unbake.training.loop import fit
from unbake.training.problem import make_problem
from unbake.training.recovered import load_run
from unbake.training.schedule import learning_rates
from unbake.training.state import initial_state
from unbake.training.step import TrainingStep
from unbake.training.validation import GroundTruth, MaterialBuffers

THREE = ("albedo", "roughness", "metallic")

#: A metal ball on a floor that is none, in the light of a sky that has a bright and a dark side.
METAL = """<scene version="3.0.0">
  <bsdf type="principled" id="metal">
    <rgb name="base_color" value="0.8 0.5 0.3"/><float name="roughness" value="0.3"/>
    <float name="metallic" value="0.9"/></bsdf>
  <bsdf type="principled" id="floor">
    <rgb name="base_color" value="0.3 0.6 0.4"/><float name="roughness" value="0.5"/></bsdf>
  <shape type="sphere"><ref id="metal"/></shape>
  <shape type="rectangle"><ref id="floor"/><transform name="to_world">
    <scale value="3"/><translate z="-1"/></transform></shape>
  <emitter type="directional"><vector name="direction" value="-1 -0.5 -1"/>
    <rgb name="irradiance" value="3"/></emitter>
  <emitter type="constant"><rgb name="radiance" value="0.6 0.8 1"/></emitter>
</scene>"""


@pytest.fixture(scope="module")
def metal(tmp_path_factory):
    """Photographs of the metal ball, and its truth."""
    folder = tmp_path_factory.mktemp("metal")
    (folder / "scene.xml").write_text(METAL)
    small = CaptureSettings(views=8, held_out=1, resolution=32, spp=64, max_depth=6)
    capture(str(folder / "scene.xml"), folder / "data", small, tell=lambda line: None)
    return folder / "data"


def test_truth_is_what_the_scene_says(metal):
    view = Dataset.load(metal).heldout[0]
    assert tuple(view.truth) == THREE
    pictures = {name: read_exr(file) for name, file in view.truth.items()}
    inside = pictures["metallic"][..., 3] == 1
    metallic, albedo = (pictures[name][inside] for name in ("metallic", "albedo"))
    assert np.ptp(metallic[:, :3], axis=1).max() == 0
    # Pixels on the outline of the ball see both.
    ball, floor = np.isclose(metallic[:, 0], 0.9, atol=1e-4), metallic[:, 0] == 0
    assert ball.sum() > 20 and floor.sum() > 20 and (metallic[:, 0] <= 0.9001).all()
    np.testing.assert_allclose(albedo[ball][:, :3], [[0.8, 0.5, 0.3]] * ball.sum(), atol=1e-3)
    np.testing.assert_allclose(albedo[floor][:, :3], [[0.3, 0.6, 0.4]] * floor.sum(), atol=1e-3)


def test_metallic_alone_is_recovered_where_all_else_is_known(metal, tmp_path):
    config = update(
        TINY_FIT,
        {
            "quantities": ["metallic"],
            "representation": "grid",
            "method": "direct",
            "steps": 300,
            "pixels": 256,
            "warm_up": 0,
            "loss_epsilon": 0.01,
            "materials": {"metallic": {"grid": {"cells": 8, "learning_rate": 0.3}}},
        },
    )
    found = {}
    for steps in (1, 300):
        run = tmp_path / f"{steps}"
        fit(metal, run, update(config, {"steps": steps}))
        recovered = load_run(run)
        assert tuple(recovered.problem.materials) == ("metallic",)
        view = recovered.dataset.heldout[0]
        truth, (seen,) = (
            GroundTruth.of(view),
            MaterialBuffers.of(recovered.problem, [view], 16, seed=1),
        )
        mask, true = seen.mask(truth), truth.values["metallic"][..., 0]
        value = seen.values["metallic"][..., 0]
        ball, floor = value[mask & (true > 0.89)].mean(), value[mask & (true < 0.01)].mean()
        found[steps] = (ball, floor, seen.psnr(truth)["metallic_psnr"])
        assert seen.psnr(truth).keys() == {"metallic_psnr"}
    print(found)
    ball, floor, psnr = found[300]
    # From 0.1 everywhere, with 9.7 dB.
    assert ball > 0.7 and floor < 0.05 and psnr > found[1][2] + 6


def test_an_untrained_field_starts_where_the_table_says():
    for name, row in QUANTITIES.items():
        assert row.lower < row.initial < row.upper, name
        assert row.lower <= row.default <= row.upper, name


def test_all_quantities_travel_to_the_bsdfs():
    import mitsuba as mi

    si = dr.zeros(mi.SurfaceInteraction3f, 2)
    material = {
        "metallic": mi.Float([0.5, 0.6]),
        "albedo": mi.Color3f(0.1, 0.2, 0.3),
        "roughness": mi.Float(0.4),
    }
    carry(si, material)
    found = read_carried(si, THREE)
    assert tuple(found) == THREE
    for name, value in material.items():
        np.testing.assert_array_equal(*np.broadcast_arrays(np.array(found[name]), np.array(value)))
    # Those that are not chosen leave no gap.
    carry(si, {"albedo": material["albedo"], "metallic": material["metallic"]})
    np.testing.assert_array_equal(np.array(si.dn_dv.x), np.array(material["metallic"]))


def test_three_quantities_from_a_fit_to_a_page(unbake, cornell, tiny, tmp_path, monkeypatch):
    run, page = tmp_path / "run", tmp_path / "report.html"
    words = ("--settings", tiny, "--steps", 6, "--quantities", *THREE)
    done = unbake("fit", cornell, "--out", run, *words)
    assert done.status == 0, done.err
    assert 'quantities = ["albedo", "roughness", "metallic"]' in (run / "config.toml").read_text()
    assert "[materials.metallic.neural]" in (run / "config.toml").read_text()
    assert "metallic" in done.out and " dB" in done.out  # the validation

    done = unbake("evaluate", run, "--spp", 4, "--train-views", 0)
    assert done.status == 0, done.err
    metrics = json.loads((run / "evaluation" / "metrics.json").read_text())
    assert metrics["quantities"] == list(THREE)
    assert np.isfinite(metrics["heldout"]["metallic_psnr"])
    assert {p.name for p in (run / "evaluation" / "heldout").glob("*.png")} == {
        f"heldout_000_{name}.png" for name in ("render", *THREE)
    }
    done = unbake("report", run, "--out", page)
    assert done.status == 0, done.err
    text = page.read_text()
    assert text.count(">Metallic</th>") == text.count(">Roughness</th>") > 0
    assert "albedo, roughness and metallic recovered" in " ".join(text.split())

    monkeypatch.setattr(yardsticks, "STEPS", 20)
    words = ("--steps", 4, "--settings", tiny, "--evaluate-spp", 2, "--quantities", *THREE)
    done = unbake("compare", cornell, "--methods", "direct", "--out", tmp_path / "two", *words)
    assert done.status == 0, done.err
    assert "metallic" in done.out
    compared = json.loads((tmp_path / "two" / "compare.json").read_text())["methods"]["direct"]
    assert np.isfinite(compared["heldout"]["metallic_psnr"])
    assert "metallic_psnr" in compared["score"][-1]


def test_a_data_set_without_that_truth_gives_no_score(unbake, cornell, tiny, tmp_path):
    data = shutil.copytree(cornell, tmp_path / "data")
    shutil.rmtree(data / "truth" / "metallic")
    run = tmp_path / "run"
    words = ("--settings", tiny, "--steps", 4, "--quantities", *THREE)
    done = unbake("fit", data, "--out", run, *words)
    assert done.status == 0, done.err
    assert unbake("evaluate", run, "--spp", 4, "--train-views", 0).status == 0
    heldout = json.loads((run / "evaluation" / "metrics.json").read_text())["heldout"]
    assert heldout["metallic_psnr"] is None and np.isfinite(heldout["albedo_psnr"])
    assert unbake("report", run, "--out", tmp_path / "report.html").status == 0


@pytest.mark.parametrize("method", ["ours", "prb"])
@pytest.mark.parametrize("chosen", [("roughness",), ("albedo", "metallic")], ids="+".join)
def test_any_choice_of_quantities_trains_and_is_replayed(built_in, method, chosen):
    """Without an unknown albedo, L_θ takes that of the scene."""
    gc.collect()
    config = replace(TINY_FIT, quantities=chosen, method=method, representation="grid")
    problem = make_problem(built_in("cornell"), "visible", config, 0.2)
    pixels = grey_photographs(built_in_cameras("cornell", 8, views=2))
    step, state = TrainingStep(problem, pixels, config), initial_state(problem)
    before = {key: np.array(value) for key, value in state.phi.items()}
    assert {key.partition(".")[0] for key in before} == set(chosen)
    assert_only_replayed(step, state, lambda i: learning_rates(config, i, 0.0))
    for key, old in before.items():
        assert (np.array(state.phi[key]) != old).any(), key
