"""Bounces of a fit look for light: what the guide has learned takes noise out of its steps."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import of_format, seeded, tiny_fields

from unbake.acquisition.capture import capture
from unbake.acquisition.settings import CaptureSettings
from unbake.config import read_toml, to_toml
from unbake.dataset.views import Dataset
from unbake.fields.domain import Domain
from unbake.fields.guide import LightGuide
from unbake.fields.settings import GuideConfig
from unbake.training.problem import pixels_of, problem_of
from unbake.training.schedule import learning_rates
from unbake.training.state import initial_state
from unbake.training.step import TrainingStep
from unbake.transport.operator import mixture_at
from unbake.transport.vertex import SceneView, find_vertex

STEPS, GUIDE = 150, "guide.directions"


@pytest.fixture(scope="module")
def fitted(cornell):
    """A step with its state after a short fit, and its pixels."""
    config = replace(tiny_fields(), pixels=256, guide=GuideConfig(cells=4, bands=4, sectors=8))
    dataset = Dataset.load(cornell)
    pixels = pixels_of(dataset, config, clip_negative=False)
    problem = problem_of(dataset, config, pixels.photographs.level)
    step, state = TrainingStep(problem, pixels, config), initial_state(problem)
    terms = [step(state, i, learning_rates(config, i, i / STEPS)) for i in range(STEPS)]
    return step, state, pixels, [float(term["guide"][0]) for term in terms]


def noise(step, state, pixels):
    """Mean variance of a pixel's estimate from half of its samples."""
    halves = step.probe(state, pixels.rays, pixels.draw(3, 256), seed=5)
    return float(np.square(halves[:, 0] - halves[:, 1]).mean() / 2)


def test_what_the_guide_has_learned_takes_noise_out_of_steps(fitted):
    step, state, pixels, losses = fitted
    assert np.mean(losses[-30:]) < np.mean(losses[:30])
    learned = noise(step, state, pixels)
    before = state.snapshot()
    state.theta[GUIDE] = dr.zeros(mi.Float, dr.width(state.theta[GUIDE]))
    uniform = noise(step, state, pixels)
    state.restore(before)
    print(f"variance {learned:.4g} with the guide, {uniform:.4g} with even directions")
    assert learned < 0.9 * uniform
    assert noise(step, state, pixels) == learned


@pytest.mark.parametrize(
    ("bsdf", "guided"),
    [
        ({"type": "principled"}, True),
        ({"type": "mask", "opacity": 0.6, "bsdf": {"type": "principled"}}, True),
        ({"type": "plastic"}, False),  # its coating reflects in one direction
    ],
    ids=["principled", "cut-out", "plastic"],
)
def test_the_guide_draws_where_all_directions_have_a_density(bsdf, guided):
    pane = {"type": "rectangle", "bsdf": bsdf}
    scene = mi.load_dict({"type": "scene", "pane": pane, "sky": {"type": "constant"}})
    guide = LightGuide(GuideConfig(cells=2), Domain.of(scene.bbox()))
    guide.prepare()
    ray = mi.Ray3f(mi.Point3f(dr.linspace(mi.Float, -0.5, 0.5, 64), 0, 2), mi.Vector3f(0, 0, -1))
    vertex = find_vertex(SceneView.of(scene, None, 4), ray, mi.Bool(True), seeded(1, 64))
    met = np.array(vertex.valid)
    share = np.array(mixture_at(guide, vertex).share)
    assert met.any() and (share[met] > 0).all() == guided and (share[~met] == 0).all()


#: A floor, and a card of which nothing is seen, before the sky.
WITH_HOLES = """<scene version="3.0.0"><emitter type="constant"/>
  <shape type="rectangle"><bsdf type="principled"/></shape>
  <shape type="rectangle"><bsdf type="mask"><float name="opacity" value="0"/>
    <bsdf type="twosided"><bsdf type="principled"/></bsdf></bsdf>
    <transform name="to_world"><rotate x="1" angle="90"/><translate z="1"/></transform></shape>
</scene>"""


def test_no_step_is_skipped_where_holes_show_the_sky(tmp_path):
    (tmp_path / "scene.xml").write_text(WITH_HOLES)
    settings = CaptureSettings(views=2, held_out=0, resolution=8, spp=4, max_depth=4)
    capture(tmp_path / "scene.xml", tmp_path / "data", settings, tell=lambda line: None)
    dataset = replace(Dataset.load(tmp_path / "data"), background="visible")
    config = replace(tiny_fields(), pixels=64, guide=GuideConfig(cells=4, bands=4, sectors=8))
    pixels = pixels_of(dataset, config, clip_negative=False)
    problem = problem_of(dataset, config, pixels.photographs.level)
    step, state = TrainingStep(problem, pixels, config), initial_state(problem)
    for number in range(6):
        terms = step(state, number, learning_rates(config, number, number / 6))
        assert terms["skipped"][0] == 0, {name: x[0] for name, x in terms.items()}


def test_methods_without_a_radiance_field_and_settings_without_cells_have_no_guide(cornell):
    dataset, config = Dataset.load(cornell), tiny_fields()
    guided = [
        problem_of(dataset, changed, 1.0).guide is not None
        for changed in (config, replace(config, guide=GuideConfig(cells=0)))
    ]
    assert guided == [True, False]
    assert problem_of(dataset, replace(config, method="direct"), 1.0).guide is None


def test_runs_of_before_go_on_without_a_guide(tmp_path):
    text = to_toml(tiny_fields())
    start = text.index("[guide]")
    table = text[start : text.index("\n[", start)]
    file = tmp_path / "config.toml"
    file.write_text(text)
    assert read_toml(file).guide.cells == GuideConfig().cells
    file.write_text(of_format(text.replace(table, ""), 2))
    assert read_toml(file).guide.cells == 0
