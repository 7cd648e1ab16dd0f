"""Fits of unknown light: what they recover, their gradients, their steps, and their errors."""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import (
    TINY_FIT,
    assert_frozen_as_unfrozen,
    assert_only_replayed,
    built_in_cameras,
    grey_photographs,
    one_thread,
    pixel_rays,
    randomised,
    seeded,
    with_more,
)

from unbake.acquisition.capture import capture
from unbake.acquisition.settings import CaptureSettings
from unbake.config import LightingConfig, from_toml, update
from unbake.dataset.lighting import true_environment
from unbake.errors import UserError
from unbake.evaluation.lighting import recovered_emitters, sh_error
from unbake.training.first_lights import begin_lights
from unbake.training.problem import make_problem, training_pixels
from unbake.training.regularizers import is_anchored
from unbake.training.schedule import learning_rates
from unbake.training.state import initial_state
from unbake.training.step import TrainingStep
from unbake.training.told_scale import weigh_convention
from unbake.transport.prb import materials_along_paths, path_radiance, path_replay
from unbake.transport.wavefront import PathLimits, path_light, plan_widths

FAST = LightingConfig(resolution=16, learning_rate=0.1, coarse_gain=1.0)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    """Captured data sets by the name of their scene, to be read alone."""
    folder, captured = tmp_path_factory.mktemp("lit"), {}

    def of(name):
        if name not in captured:
            small = CaptureSettings(views=4, held_out=1, resolution=24, spp=64, max_depth=8)
            captured[name] = capture(name, folder / name, small, tell=lambda line: None)
        return captured[name]

    return of


def fitted(dataset, unknown, *, steps=200, **settings):
    """The problem after a short fit, and the radiance that it began with."""
    settings = {"pixels": 64, "warm_up": 20, "lighting": FAST} | settings
    config = dataclasses.replace(TINY_FIT, unknown=unknown, **settings)
    config = update(config, {"materials": {"albedo": {"neural": {"learning_rate": 0.02}}}})
    pixels = training_pixels(dataset, clip_negative=False)
    mean = pixels.photographs.level
    problem = make_problem(dataset.scene, dataset.background, config, mean)
    begin_lights(problem, pixels)
    step, state = TrainingStep(problem, pixels, config), initial_state(problem)
    for i in range(steps):
        weigh_convention(problem, config, i / steps)
        terms = step(state, i, learning_rates(config, i, i / steps))
        if i % 50 == 0:
            assert np.isfinite(sum(float(v[0]) for v in terms.values()))
    assert float(terms["skipped"][0]) == 0 and step.recordings() <= 3
    state.publish(problem)
    return problem, mean


# --------------------------------------------------------------------------------- what is found


@pytest.mark.parametrize("method", ["ours", "prb"])
def test_the_strength_of_a_lamp_is_found(photographs, method):
    dataset = photographs("cornell")
    problem, mean = fitted(dataset, "emission", method=method)
    (light,) = recovered_emitters(problem, dataset.folder)
    print(light, mean)
    assert light.truth == pytest.approx([13, 10, 6.5])
    assert mean < 0.3  # where it began, far from the truth
    assert light.emission_error < 0.05


def closed_room(folder, lamp):
    """Photographs of a room of one colour, (0.2, 0.3, 0.1), with this lamp in it."""
    (folder / "scene.xml").write_text(
        f"""<scene version="3.0.0"><sensor type="perspective">
          <float name="fov" value="70"/><transform name="to_world">
            <lookat origin="0.5,-2.5,0.5" target="0,0,0" up="0,0,1"/></transform></sensor>
          <shape type="cube"><transform name="to_world"><scale value="3"/></transform>
            <boolean name="flip_normals" value="true"/>
            <bsdf type="principled"><rgb name="base_color" value="0.2, 0.3, 0.1"/></bsdf></shape>
          {lamp}</scene>"""
    )
    small = CaptureSettings(views=4, held_out=1, resolution=24, spp=64, max_depth=8)
    return capture(folder / "scene.xml", folder / "data", small, tell=lambda line: None)


def test_a_lamp_in_view_and_materials_are_found_together(tmp_path):
    """As bright as it is: what photographs show of it tells the scale."""
    dataset = closed_room(
        tmp_path,
        """<shape type="sphere" id="lamp"><point name="center" value="0,1,0"/>
            <float name="radius" value="0.7"/>
            <emitter type="area"><rgb name="radiance" value="2, 3, 1"/></emitter></shape>""",
    )
    problem, _ = fitted(dataset, "materials+emission", steps=400)
    (light,) = recovered_emitters(problem, dataset.folder)
    found = mean_albedo(problem, dataset)
    print(light, found)
    assert problem.shows_light and light.emission_error < 0.03
    np.testing.assert_allclose(found, [0.2, 0.3, 0.1], atol=0.03)


def test_a_lamp_that_no_photograph_depends_on_is_told(tmp_path, tiny, unbake):
    (tmp_path / "scene.xml").write_text(
        """<scene version="3.0.0">
          <sensor type="perspective"><transform name="to_world">
            <lookat origin="0,-5,6" target="0,0,0" up="0,0,1"/></transform></sensor>
          <shape type="rectangle"><transform name="to_world"><scale value="3"/></transform></shape>
          <shape type="cube"><transform name="to_world"><scale value="0.4"/>
            <translate z="0.5"/></transform></shape>
          <emitter type="point" id="inside"><point name="position" value="0,0,0.5"/></emitter>
          <emitter type="point" id="outside"><point name="position" value="0,0,4"/></emitter>
        </scene>"""
    )
    small = CaptureSettings(views=2, held_out=1, resolution=12, spp=4, max_depth=4)
    capture(tmp_path / "scene.xml", tmp_path / "data", small, tell=lambda line: None)
    words = ["--settings", tiny, "--unknown", "emission", "--steps", 20]
    outcome = unbake("fit", tmp_path / "data", "--out", tmp_path / "run", *words)
    said = " ".join(outcome.out.split())
    assert outcome.status == 0, outcome
    assert "no photograph depends on the strength of inside, along" in said


@pytest.mark.parametrize("size", [1.0, 0.01, 100.0])
def test_points_begin_as_bright_as_the_size_of_the_scene_asks_for(size, tmp_path):
    """In a room of any size, so that a surface has about the mean radiance of photographs."""
    floor = f'<scale value="{size}"/><rotate x="1" angle="-90"/>'
    scene = tmp_path / "scene.xml"
    scene.write_text(
        f"""<scene version="3.0.0">
          <shape type="rectangle"><transform name="to_world">{floor}</transform>
            <bsdf type="principled"/></shape>
          <shape type="rectangle"><transform name="to_world">{floor}
            <translate y="{2 * size}"/></transform><bsdf type="principled"/></shape>
          <emitter type="point"><point name="position" value="0,{size},0"/></emitter>
          <emitter type="constant"/></scene>"""
    )
    config = dataclasses.replace(TINY_FIT, unknown="emission")
    problem = make_problem(scene, "visible", config, 0.5)
    point, sky = np.array(problem.emission.values).T
    np.testing.assert_allclose(sky, 0.5, rtol=1e-5)
    assert size**2 < point[0] / 0.5 < 2 * size**2


@pytest.mark.parametrize("method", ["ours", "prb"])
def test_low_frequencies_of_an_environment_are_found(photographs, method):
    dataset = photographs("still")
    truth = true_environment(dataset.folder)
    problem, mean = fitted(dataset, "lighting", method=method)
    found = sh_error(problem.environment.to_latlong(len(truth)), truth)
    start = sh_error(np.full_like(truth, mean), truth)
    print(found, start)
    assert start > 0.7 and found < 0.6 * start


def mean_albedo(problem, dataset):
    rays = pixel_rays([view.camera for view in dataset.train], 1, 0)
    si = problem.scene_view.scene.ray_intersect(rays)
    with dr.suspend_grad():
        albedo = np.array(problem.materials.evaluate(si, si.is_valid())["albedo"])
    return albedo[:, np.array(si.is_valid())].mean(1)


def test_the_mean_albedo_is_the_convention_where_nothing_else_tells_it(photographs):
    dataset = photographs("still")
    assert dataset.background == "hidden"
    means = {}
    for anchor in (1.0, 0.0):
        lighting = dataclasses.replace(FAST, mean_albedo=0.25, anchor=anchor)
        problem, _ = fitted(dataset, "materials+lighting", lighting=lighting)
        means[anchor] = mean_albedo(problem, dataset)
        wanted = problem.mean_albedo
    print(means, wanted)
    assert np.mean(wanted) == pytest.approx(0.25) and np.ptp(wanted) > 0.02
    np.testing.assert_allclose(means[1.0], wanted, atol=0.03)
    assert means[0.0].min() > 0.35
    visible = dataclasses.replace(problem, hide_emitters=False)
    assert not is_anchored(visible, dataclasses.replace(TINY_FIT, unknown="materials+lighting"))


def test_light_between_surfaces_tells_of_the_scale_that_begins_at_a_convention(tmp_path):
    """Of a closed room whose lamp no photograph shows."""
    dataset = closed_room(
        tmp_path,
        """<emitter type="point" id="lamp"><point name="position" value="0,1,1"/>
            <rgb name="intensity" value="4"/></emitter>""",
    )
    errors = {}
    for final_anchor in (1.0, 0.003):
        lighting = dataclasses.replace(FAST, final_anchor=final_anchor)
        problem, _ = fitted(dataset, "materials+emission", steps=400, lighting=lighting)
        assert problem.shows_light is False and problem.anchor == pytest.approx(final_anchor)
        errors[final_anchor] = np.abs(mean_albedo(problem, dataset) - [0.2, 0.3, 0.1])
    print(errors)
    assert (errors[0.003] < errors[1.0] - 0.03).all()


def test_a_mirror_tells_the_scale_that_is_a_convention_without_it(tmp_path):
    """Its pixels are the radiance of the environment, though the background is hidden."""
    grey = '<rgb name="base_color" value="0.2"/><float name="specular" value="0"/>'
    balls = "".join(
        f"""<shape type="sphere"><point name="center" value="{3 * i},0,0"/>
          <bsdf type="{kind}">{grey if kind == "principled" else ""}</bsdf></shape>"""
        for i, kind in enumerate(("principled", "conductor", "principled"), -1)
    )
    (tmp_path / "scene.xml").write_text(
        f"""<scene version="3.0.0"><sensor type="perspective">
          <float name="fov" value="45"/><transform name="to_world">
            <lookat origin="0,-11,4" target="0,0,0" up="0,0,1"/></transform></sensor>{balls}
          <emitter type="constant"><rgb name="radiance" value="0.8"/></emitter></scene>"""
    )
    small = CaptureSettings(views=4, held_out=1, resolution=24, spp=64, max_depth=8)
    dataset = capture(tmp_path / "scene.xml", tmp_path / "data", small, tell=lambda line: None)
    assert dataset.background == "hidden"
    problem, _ = fitted(dataset, "materials+lighting", steps=120)
    rays = pixel_rays([view.camera for view in dataset.train], 1, 0)
    si = problem.scene_view.scene.ray_intersect(rays)
    grey = si.is_valid() & problem.scene_view.is_optimized(si.shape)
    with dr.suspend_grad():
        albedo = np.array(problem.materials.evaluate(si, grey)["albedo"])[:, np.array(grey)]
    np.testing.assert_allclose(albedo.mean(1), 0.2, atol=0.06)


# ------------------------------------------------------------------------------------ gradients

DEPTH = 4


def radiance(problem, method, ray, seed):
    """Radiance of camera rays by whole paths, as the training step asks for it."""
    scene_view, sampler = problem.scene_view, seeded(seed, dr.width(ray))
    if method == "prb":
        replay = path_replay(DEPTH, DEPTH, hide_emitters=problem.hide_emitters)
        with materials_along_paths(scene_view.materials):
            return path_radiance(replay, scene_view.scene, sampler, ray, problem.read_by_scene())
    limits = PathLimits(DEPTH, DEPTH, hide_emitters=problem.hide_emitters)
    plan = plan_widths(scene_view, ray, sampler.clone(), 2, limits, 1)
    return path_light(scene_view, ray, sampler, 2, limits, plan)


def weighted(radiance, spp):
    """A linear objective of three numbers, the channels: means of samples with fixed weights."""
    weights = np.random.default_rng(3).uniform(0.5, 1.5, (3, dr.width(radiance) // spp))
    weights = mi.Color3f(np.repeat(weights, spp, axis=1).astype(np.float32))
    return [dr.mean(channel) for channel in weights * radiance]


def with_gradients(built_in, name, unknown, method):
    """A problem whose light is not the same everywhere, and its parameters."""
    config = dataclasses.replace(TINY_FIT, unknown=unknown, method=method, lighting=FAST)
    problem = make_problem(built_in(name), "visible", config, 0.5)
    return problem, randomised(problem, scale=0.5)


@pytest.mark.parametrize(("initial", "start"), [(0.0, 0.3), (1.0, 1.0)])
def test_an_environment_starts_as_the_settings_say(built_in, initial, start):
    lighting = LightingConfig(resolution=8, initial_radiance=initial)
    config = dataclasses.replace(TINY_FIT, unknown="lighting", lighting=lighting)
    problem = make_problem(built_in("still"), "hidden", config, 0.3)
    np.testing.assert_allclose(problem.environment.to_latlong(8), start, rtol=1e-5)


@pytest.mark.parametrize("method", ["prb", "ad-pt"])
def test_gradients_of_the_log_of_a_strength_are_its_light(built_in, method):
    """The picture is linear in the only light: so its own derivative by the log of that."""
    problem, values = with_gradients(built_in, "cornell", "emission", method)
    ray = pixel_rays(built_in_cameras("cornell", 12), 16, 1)
    channels = weighted(radiance(problem, method, ray, 2), 16)
    expected = [float(c[0]) for c in channels]
    dr.backward(sum(channels))
    assert min(expected) > 0.005
    np.testing.assert_allclose(dr.grad(values["emission.log"]), expected, rtol=1e-4)


@pytest.mark.parametrize("method", ["prb", "ad-pt"])
def test_gradients_reach_every_level_of_the_environment(built_in, method):
    """Against finite differences. Sampling is detached: its tables stay as they are."""
    problem, values = with_gradients(built_in, "still", "lighting", method)
    ray = pixel_rays(built_in_cameras("still", 12), 16, 1)
    dr.backward(sum(weighted(radiance(problem, method, ray, 2), 16)))
    tables = {k: v for k, v in problem.environment.tables.items() if k != "texels"}
    assert set(tables) == {"probability", "columns", "rows"}
    rng = np.random.default_rng(4)
    for name, value in values.items():
        direction = rng.normal(0, 1, dr.width(value)).astype(np.float32)
        direction *= np.sign(np.array(dr.grad(value)))  # or positive and negative would cancel

        def moved(h, name=name, value=value, direction=direction):
            with dr.suspend_grad():
                problem.assign({**values, name: value + h * mi.Float(direction)})
                problem.environment.tables.update(tables)
                total = sum(weighted(radiance(problem, method, ray, 2), 16))
                return float(total[0])

        difference = (moved(0.02) - moved(-0.02)) / 0.04
        gradient = np.dot(np.array(dr.grad(value), np.float64), direction)
        print(name, gradient, difference)
        assert abs(difference) > 1e-3, "a gradient of zero proves nothing"
        assert gradient == pytest.approx(difference, rel=1e-2)


@pytest.mark.parametrize("name", ["cornell", "still"])
def test_replayed_paths_and_bounces_have_one_gradient(built_in, name):
    unknown = {"cornell": "emission", "still": "lighting"}[name]
    gradients = []
    for method in ("prb", "ad-pt"):
        problem, values = with_gradients(built_in, name, unknown, method)
        ray = pixel_rays(built_in_cameras(name, 12), 1024, 1)
        dr.backward(sum(weighted(radiance(problem, method, ray, 2), 1024)))
        # Coarse texels: finer ones get few samples each.
        first = next(iter(values.values()))
        gradients.append(np.array(dr.grad(first), np.float64))
    a, b = gradients
    assert np.abs(a).max() > 1e-2
    assert np.abs(a - b).max() < 0.03 * np.abs(a).max()


# ------------------------------------------------------------------------------------ the step


def start(built_in, unknown, method, background="hidden"):
    """A fresh fit of grey photographs: its step and its state."""
    name = "cornell" if unknown == "emission" else "still"
    config = dataclasses.replace(
        TINY_FIT,
        unknown=unknown,
        method=method,
        lighting=LightingConfig(resolution=8),
        # Networks along paths, in virtual calls, take seconds to compile.
        representation="grid" if method == "prb" else "neural",
    )
    cells = {"albedo": {"grid": {"cells": 5}}, "roughness": {"grid": {"cells": 3}}}
    config = update(config, {"materials": cells})
    scene = built_in(name)
    if {"lighting", "emission"} <= {*unknown.split("+")}:
        scene = with_more(scene, LAMP)
    problem = make_problem(scene, background, config, 0.2)
    pixels = grey_photographs(built_in_cameras(name, 8, views=2))
    return TrainingStep(problem, pixels, config), initial_state(problem)


def rates(i):
    """Learning rates that are others in each step, as those of a fit are."""
    names = ("albedo", "roughness", "environment", "emission", "radiance")
    return dict.fromkeys(names, 3e-3 * 0.9**i)


KINDS = ["lighting", "emission", "materials+lighting", "materials+lighting+emission"]
LAMP = '<emitter type="point"><point name="position" value="0,0,3"/></emitter>'


@pytest.mark.parametrize("unknown", KINDS)
@pytest.mark.parametrize("method", ["ours", "prb"])
def test_frozen_and_unfrozen_steps_are_the_same(built_in, unknown, method):
    fits = [start(built_in, unknown, method) for _ in range(2)]
    near = {"rtol": 1e-4, "atol": 1e-6}
    with one_thread():
        taken = assert_frozen_as_unfrozen(*fits, rates, of_terms=near, atol=1e-5)
    for terms in taken:
        assert ("mean_albedo" in terms) == ("materials+lighting" in unknown)


@pytest.mark.parametrize("unknown", KINDS)
def test_nothing_is_compiled_or_traced_after_the_third_step(built_in, unknown):
    step, state = start(built_in, unknown, "ours")
    assert_only_replayed(step, state, rates)


def test_a_fit_is_not_disturbed_by_light_of_another_one(built_in):
    """A frozen function calls every emitter there is, and must find what it reads."""
    steps = [start(built_in, unknown, "direct", "visible") for unknown in KINDS[:2]]
    for i in range(5):
        for step, state in steps:
            assert np.isfinite(float(step(state, i, rates(i))["photometric"][0]))
    assert all(step.recordings() <= 3 for step, _ in steps)


# --------------------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("name", "unknown", "message"),
    [
        ("cornell", "lighting", "scene.xml: the scene has no environment map to fit. Add one"),
        ("cornell", "materials+lighting", "scene.xml: the scene has no environment map to fit"),
        ("still", "emission", "scene.xml: the scene has no light to fit: no area, point"),
    ],
)
def test_a_scene_without_the_unknown_is_told_before_anything_is_written(
    name, unknown, message, photographs, unbake, tmp_path
):
    data, run = photographs(name).folder, tmp_path / "run"
    outcome = unbake("fit", data, "--out", run, "--unknown", unknown)
    assert outcome.status == 2 and not run.exists()
    assert outcome.err.startswith("error: ") and message in outcome.err
    assert outcome.err.count("\n") == 1


@pytest.mark.parametrize("bounces", [-1, 17, 1000])
def test_bounces_that_would_not_fit_are_refused(bounces, unbake, tmp_path):
    run = tmp_path / "run"
    outcome = unbake("fit", "data", "--out", run, "--bounces", bounces)
    assert outcome.status == 2 and not run.exists()
    assert outcome.err.startswith("error: --bounces: must be 0 to 16")
    assert outcome.err.count("\n") == 1
    with pytest.raises(UserError, match=r"here.toml: bounces: must be 0 to 16"):
        from_toml(f"bounces = {bounces}", "here.toml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("resolution = 12", "lighting.resolution: must be 8, 16, 32"),
        ("learning_rate = 0.0", "lighting.learning_rate: must be positive"),
        ("learning_rate = inf", "lighting.learning_rate: must be a finite number, not inf"),
        ("mean_albedo = 1.0", "lighting.mean_albedo: must be between 0 and 1"),
        ("anchor = -1.0", "lighting.anchor: must be 0 or more"),
    ],
)
def test_wrong_settings_of_lighting_are_named(text, message):
    with pytest.raises(UserError, match=message):
        from_toml(f"[lighting]\n{text}", "here.toml")
