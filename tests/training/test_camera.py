"""Cameras: exposures and clipping that the data set tells, and what a fit makes of them."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import (
    TINY_FIT,
    assert_only_replayed,
    built_in_cameras,
    grey_photographs,
    last_state,
    parameters_of,
    randomised,
    whole_and_in_parts,
)

from unbake.acquisition.degrade import response
from unbake.config import CameraConfig, from_toml, read_toml, to_toml
from unbake.dataset.camera import Camera
from unbake.dataset.fingerprint import changed, fingerprint
from unbake.dataset.photographs import Photographs
from unbake.dataset.pixels import CameraRays
from unbake.dataset.views import Dataset, SensorNoise, View
from unbake.errors import UserError
from unbake.evaluation.evaluate import evaluate
from unbake.evaluation.settings import EvaluationSettings
from unbake.fields.camera import CameraModel
from unbake.imaging.pictures import read_exr, write_exr
from unbake.report.page import write_report
from unbake.scene.parse import parse
from unbake.training import first_gains as first_gains_module
from unbake.training.cameras import Cameras
from unbake.training.first_gains import (
    SharedPoints,
    _partners,
    begin_cameras,
    first_gains,
    shared_points,
)
from unbake.training.first_response import SeenPoints, first_response, log_falloff
from unbake.training.fresh_fit import begin_fit
from unbake.training.held_aside import HeldAside, HeldOutPhotographs
from unbake.training.loop import fit
from unbake.training.problem import make_problem, pixels_of, problem_of, training_pixels
from unbake.training.recovered import load_run
from unbake.training.run_folder import RunFolder
from unbake.training.schedule import learning_rates
from unbake.training.state import initial_state
from unbake.training.step import TrainingStep
from unbake.transport.loss import RelativeL2, pixel_means, squared_error

#: Powers of two, so that dividing by them gives back the very numbers.
EXPOSURES = (4.0, 0.5, 2.0)


def edit_frames(data, change):
    """Change the frames of a data set: `change(frame, number)`."""
    file = data / "transforms.json"
    content = json.loads(file.read_text())
    for number, frame in enumerate(content["frames"]):
        change(frame, number)
    file.write_text(json.dumps(content))
    return data


def expose(data, exposures, *, told=True):
    """Multiply the photographs of a data set, and tell so or not."""

    def change(frame, number):
        image = data / frame["file_path"]
        pixels = read_exr(image)
        pixels[..., :3] *= exposures[number]
        write_exr(image, pixels)
        if told:
            frame["exposure"] = exposures[number]

    return edit_frames(data, change)


@pytest.fixture(scope="module")
def exposed(cornell, tmp_path_factory):
    """The room, each photograph with an exposure that the data set tells."""
    data = shutil.copytree(cornell, tmp_path_factory.mktemp("exposed") / "data")
    return expose(data, EXPOSURES)


@pytest.fixture(scope="module")
def config(tiny):
    return replace(read_toml(tiny), method="direct", held_aside=0.25)


# ------------------------------------------------------------------------------ what data sets tell


def test_exposure_and_limit_are_read_and_saved_again(exposed, tmp_path):
    data = shutil.copytree(exposed, tmp_path / "data")
    content = json.loads((data / "transforms.json").read_text())
    content["clipped"] = 0.75
    content["frames"][1]["clipped"] = None
    (data / "transforms.json").write_text(json.dumps(content))
    for _ in range(2):
        views = Dataset.load(data).views
        assert [view.exposure for view in views] == list(EXPOSURES)
        assert [view.clipped for view in views] == [0.75, None, 0.75]
        assert [view.limit for view in views] == [0.1875, np.inf, 0.375]
        Dataset.load(data).save(data)
    assert "clipped" not in json.loads((data / "transforms.json").read_text())


@pytest.mark.parametrize("key", ["exposure", "clipped"])
@pytest.mark.parametrize("value", [0, -1, "bright", 1e13, True])
def test_values_that_no_camera_has_are_refused(cornell, tmp_path, key, value):
    data = shutil.copytree(cornell, tmp_path / "data")
    edit_frames(data, lambda frame, number: frame.update({key: value}))
    with pytest.raises(UserError, match=f"'{key}' is not a number from 1e-12 to 1e"):
        Dataset.load(data)


def test_noise_is_read_and_saved_again(cornell, tmp_path):
    data = shutil.copytree(cornell, tmp_path / "data")
    content = json.loads((data / "transforms.json").read_text())
    content["noise"] = {"shot": 0.001, "read": 0.002}
    content["frames"][1]["noise"] = {"read": 0.004}
    content["frames"][2]["noise"] = None
    (data / "transforms.json").write_text(json.dumps(content))
    prints = []
    for _ in range(2):
        dataset = Dataset.load(data)
        assert [view.noise for view in dataset.views[:3]] == [
            SensorNoise(0.001, 0.002),
            SensorNoise(0, 0.004),
            None,
        ]
        prints.append(fingerprint(dataset))
        dataset.save(data)
    assert "noise" not in json.loads((data / "transforms.json").read_text())
    assert prints[0] == prints[1] != fingerprint(Dataset.load(cornell))


@pytest.mark.parametrize(
    ("noise", "said"),
    [
        (0.1, "no table of 'shot' and 'read'"),
        ({}, "no table of 'shot' and 'read'"),
        ({"shot": 0.1, "gain": 2}, "no table of 'shot' and 'read'"),
        ({"shot": -1}, "'shot' is not a number from 1e-12 to 1e"),
        ({"read": "loud"}, "'read' is not a number from 1e-12 to 1e"),
    ],
)
def test_noise_that_no_camera_has_is_refused(cornell, tmp_path, noise, said):
    data = shutil.copytree(cornell, tmp_path / "data")
    edit_frames(data, lambda frame, number: frame.update(noise=noise))
    with pytest.raises(UserError, match=said):
        Dataset.load(data)


def test_a_photograph_is_exposed_and_clipped_radiance(cornell):
    view = replace(Dataset.load(cornell).views[0], exposure=2.0, clipped=1.5)
    radiance = np.array([0.0, 0.5, 0.75, 1.0], np.float32)
    np.testing.assert_array_equal(view.photographed(radiance), [0, 1, 1.5, 1.5])
    np.testing.assert_array_equal(view.photographed(radiance, 0.5), [0, 0.5, 0.75, 1])
    plain = replace(view, exposure=1.0, clipped=None)
    assert plain.photographed(radiance) is radiance


# ---------------------------------------------------------------------------------- known exposures


def test_photographs_of_known_exposure_are_the_radiance_of_the_scene(cornell, exposed, monkeypatch):
    plain = Photographs.load(Dataset.load(cornell), False)
    found = Photographs.load(Dataset.load(exposed), False)
    np.testing.assert_array_equal(found.table, plain.table)
    assert found.mean == plain.mean
    # Those that lie in a file are made anew where an exposure is another one
    monkeypatch.setattr("unbake.dataset.photographs.IN_MEMORY", 0)
    dataset = Dataset.load(exposed)
    np.testing.assert_array_equal(Photographs.load(dataset, False).table, plain.table)
    darker = replace(dataset, views=tuple(replace(v, exposure=8.0) for v in dataset.views))
    first = dataset.train[0].camera.width * dataset.train[0].camera.height
    table = Photographs.load(darker, False).table
    np.testing.assert_array_equal(table[:first], plain.table[:first] / 2)


def test_exposures_are_part_of_what_a_run_was_fit_to(exposed):
    dataset = Dataset.load(exposed)
    views = (replace(dataset.views[0], clipped=1.0), *dataset.views[1:])
    before, now = fingerprint(dataset), fingerprint(replace(dataset, views=views))
    assert changed(before, now) == ["photographs"]
    plain = replace(dataset, views=tuple(replace(view, exposure=1.0) for view in dataset.views))
    assert changed(before, fingerprint(plain)) == ["photographs"]


class Grey:
    """A step whose pictures have one value everywhere."""

    epsilon = 0.001

    def __init__(self, value):
        self.value = value

    def probe(self, state, rays, pixels, seed):
        return np.full((pixels.count, 2, 3), self.value)


def test_held_out_photographs_are_compared_as_they_are(exposed, config):
    dataset = Dataset.load(exposed)
    rays = CameraRays.of([view.camera for view in dataset.views])
    views = {None: dataset.views[2], 0.25: replace(dataset.views[2], clipped=0.25)}
    photograph = read_exr(views[None].image)[..., :3].astype(float)
    assert (photograph > 0.25).any() and (photograph < 0.25).any()
    for limit, view in views.items():
        one = replace(dataset, views=(*dataset.train, view))
        probe = HeldOutPhotographs(Grey(0.2), rays, one, config, clip_negative=False)
        top = limit or 1.0
        error = ((min(2 * 0.2, top) - photograph.clip(max=top)) ** 2).mean()
        assert probe.measure(None)["render_psnr"] == pytest.approx(-10 * np.log10(error), abs=1e-4)


# ----------------------------------------------------------------------------------------- clipping


def one_sided_case(primal):
    """Loss and gradient of three pixels: above, below, and one that is not clipped."""
    value = mi.Float([0.9, 0.9, 0.3, 0.3, 0.9, 0.9])
    dr.enable_grad(value)
    target = mi.Color3f(mi.Float([0.5, 0.5, 0.5]))
    clipped = dr.mask_t(mi.Color3f)(mi.Bool([True, True, False]))
    loss = RelativeL2(0.01, clipped=clipped)
    first = mi.Color3f(pixel_means(mi.Color3f(dr.detach(value)), 2)) if primal else None
    error = loss.error(mi.Color3f(value), target, 2, first)
    dr.backward(error)
    return float(error[0]), np.array(dr.grad(value)).reshape(3, 2).sum(1)


@pytest.mark.parametrize("primal", [False, True])
def test_what_is_clipped_has_neither_loss_nor_gradient_above(primal):
    loss, gradient = one_sided_case(primal)
    weight = 1 / (0.5**2 + 0.01)
    assert loss == pytest.approx(weight * (0.2**2 + 0.4**2) / 3, rel=1e-5)
    assert gradient[0] == 0
    np.testing.assert_allclose(gradient[1:], weight * 2 / 3 * np.array([-0.2, 0.4]), rtol=1e-5)


def test_the_gradient_of_clipped_channels_has_no_bias_with_two_passes():
    """Samples are a u², with noise on both sides of what the photograph shows at least."""
    count, at_least, scale, spp = 1 << 20, 0.3, 1.0, 2
    rng = np.random.default_rng(0)
    noise = rng.random((2, spp, count)).astype(np.float32) ** 2

    def shortfall(a):
        return np.minimum(a * noise.astype(np.float64).mean(1) - at_least, 0).mean()

    expected = (shortfall(scale + 0.01) ** 2 - shortfall(scale - 0.01) ** 2) / 0.02
    a = mi.Float(scale)
    dr.enable_grad(a)
    samples = mi.Color3f(a * mi.Float(noise[0].T.ravel()))
    other = mi.Color3f(mi.Float(scale * noise[1].mean(0)))
    target = mi.Color3f(mi.Float(at_least))
    target = dr.gather(mi.Color3f, target, dr.zeros(mi.UInt32, count))
    clipped = dr.full(dr.mask_t(mi.Color3f), True, count)
    error = squared_error(samples, target, spp, mi.Color3f(1), other, clipped)
    dr.backward(error)
    assert float(error[0]) == pytest.approx(shortfall(scale) ** 2, rel=0.01)
    assert float(a.grad[0]) == pytest.approx(expected, rel=0.02)


def test_of_all_pairs_clipped_channels_have_halves_and_others_pairs():
    rng = np.random.default_rng(6)
    samples = mi.Color3f([mi.Float(rng.uniform(0, 1, 24).astype(np.float32)) for _ in range(3)])
    target = mi.Color3f([mi.Float(rng.uniform(0, 1, 6).astype(np.float32)) for _ in range(3)])
    some = mi.Bool([True, False, True, False, False, True])
    for clipped in (mi.Bool([True] * 6), some):
        mask = dr.mask_t(mi.Color3f)(clipped, clipped & False, clipped)
        found, halves, plain = (
            squared_error(samples, target, 4, mi.Color3f(1), None, told, pairs=pairs)
            for told, pairs in ((mask, True), (mask, False), (None, True))
        )
        assert len({float(x[0]) for x in (found, halves, plain)}) == 3
        # By channel and pixel, of NumPy
        s = np.array(samples).reshape(3, 6, 4) - np.array(target)[..., None]
        of_pairs = (s.sum(-1) ** 2 - (s**2).sum(-1)) / 12
        of_halves = np.minimum(s[..., :2].mean(-1), 0) * np.minimum(s[..., 2:].mean(-1), 0)
        expected = np.where(np.array(mask), of_halves, of_pairs).mean()
        assert float(found[0]) == pytest.approx(expected, rel=1e-5)


def test_pixels_know_which_of_their_channels_are_clipped(exposed, config):
    data = Dataset.load(exposed)
    first, second, heldout = data.views
    views = (replace(first, clipped=0.5), second, heldout)
    begun = begin_fit(replace(data, views=views), config)
    pixels = begun.pixels.holding_aside(0.25, 0)
    for drawn in (pixels.draw(3, 64), pixels.held_aside()):
        numbers, colours = drawn.read()
        in_first = numbers < first.camera.width * first.camera.height
        expected = (colours[:, :3] * 4 >= 0.5) & in_first[:, None]
        assert expected.any() and not expected.all() and colours.shape[1] == 6
        np.testing.assert_array_equal(drawn.read_clipped(), expected)
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(0, 2 * drawn.count)
        batch = drawn.batch(pixels.rays, sampler, 2)
        np.testing.assert_array_equal(np.array(batch.clipped).T, expected)
    aside = HeldAside(Grey(100.0), pixels.rays, pixels.held_aside(), begun.config)
    held = pixels.held_aside()
    _, colours = held.read()
    errors = (100.0 - colours[:, :3].astype(float)) ** 2 * ~held.read_clipped()
    expected = (errors / (colours[:, 3:] ** 2 + Grey.epsilon)).mean()
    assert aside.measure(None)["held_aside"] == pytest.approx(expected, rel=1e-5)


def test_renderings_of_a_run_are_as_its_photographs_show_them(exposed, config, tmp_path):
    data = shutil.copytree(exposed, tmp_path / "data")

    def clip(frame, number):
        image = data / frame["file_path"]
        pixels = read_exr(image)
        limit = float(np.quantile(pixels[..., :3], 0.9))
        pixels[..., :3] = pixels[..., :3].clip(max=limit)
        write_exr(image, pixels)
        frame["clipped"] = limit

    edit_frames(data, clip)
    fit(data, tmp_path / "run", replace(config, steps=20))
    few = EvaluationSettings(spp=16, max_depth=6, train_views=1)
    found = evaluate(tmp_path / "run", few, tell=lambda line: None)
    for row in found["per_view"]:
        view = next(v for v in Dataset.load(data).views if v.name == row["name"])
        render = tmp_path / "run" / "evaluation" / view.split / f"{view.name}_render.exr"
        picture, photograph = read_exr(render)[..., :3], read_exr(view.image)[..., :3]
        assert picture.max() <= view.clipped
        # A picture in other units would be off by the exposure, 2 at least.
        assert 0.7 < picture.mean() / photograph.mean() < 1.4


# ------------------------------------------------------------------------- the model of the camera

EVERYTHING = CameraConfig("per-image", "per-image", "radial", "monotone")


def trained_model(seed=0):
    """A model with an unknown of each kind, as if it had been trained, and its arrays."""
    model = CameraModel(3, exposure=True, white_balance="per-image", vignetting=True, response=True)
    return model, randomised(model, seed, 0.3)


def test_an_untrained_camera_changes_nothing():
    model = CameraModel(3, exposure=True, white_balance="common", vignetting=True, response=True)
    view, radius2 = mi.UInt32([0, 1, 2]), mi.Float([0, 0.5, 1])
    np.testing.assert_array_equal(np.array(model.gain(view, radius2)), 1)
    values = np.array([-0.05, 0.0, 1e-4, 0.2, 0.5, 1.0, 3.0], np.float32)
    np.testing.assert_allclose(
        np.array(model.exposed(mi.Color3f(mi.Float(values)))), [values] * 3, rtol=1e-4, atol=1e-7
    )
    assert model.gains().tolist() == [[1, 1, 1]] * 3


def test_gains_and_responses_are_the_same_in_steps_and_in_evaluations():
    model, arrays = trained_model()
    view, radius2 = np.repeat(np.arange(3), 4), np.tile([0.0, 0.3, 0.6, 1.0], 3)
    gain = model.gain(mi.UInt32(view), mi.Float(radius2))
    expected = model.gains()[view] * model.falloff(radius2)[:, None]
    np.testing.assert_allclose(np.array(gain).T, expected, rtol=1e-5)
    np.testing.assert_allclose(expected[0], 1)  # the first view is the anchor
    assert np.abs(np.log(model.gains()[1:])).max() > 0.1
    values = np.linspace(0, 1.5, 31, dtype=np.float32)[:, None].repeat(3, 1)
    light = np.array(model.exposed(mi.Color3f([mi.Float(x) for x in values.T]))).T
    np.testing.assert_allclose(light, model.light(values), rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(light[0], 0, atol=1e-6)
    assert (np.diff(light, axis=0) > 0).all()
    middle = np.full((1, 3), 0.5**2.2)  # where f stays as it is, whatever it is for white
    np.testing.assert_allclose(model.light(middle), middle, rtol=1e-6)
    assert np.abs(model.light(np.ones((1, 3))) - 1).min() > 0.01
    np.testing.assert_allclose(model.photographed(light), values, rtol=1e-3, atol=1e-5)
    # About black it is straight: noise keeps its mean, and both ways agree
    noise = np.tile([[-0.001], [0.001]], (1, 3)).astype(np.float32)
    about = np.array(model.exposed(mi.Color3f([mi.Float(x) for x in noise.T]))).T
    np.testing.assert_allclose(about.mean(0), 0, atol=1e-7)
    np.testing.assert_allclose(about, model.light(noise), rtol=1e-3)
    # Gradients reach all gains and photographs, also those below zero, but no response
    below = mi.Float(values[:12, 0] - 0.1)
    dr.enable_grad(below)
    loss = dr.sum(dr.sum(gain) + dr.sum(model.exposed(mi.Color3f(below))))
    dr.backward(loss)
    for key, array in (arrays | {"photographs": below}).items():
        gradient = np.array(dr.grad(array))
        assert np.isfinite(gradient).all() and (gradient != 0).any() == ("response" not in key), key


def test_what_all_images_move_in_common_is_slow():
    model = CameraModel(3, exposure=True, white_balance="per-image")
    before = model.parameters()
    # All but the anchor's move by 0.4 in the mean, away from it; red by 0.6, blue by none.
    after = {
        "exposure.log": mi.Float(-0.2, 0.3, 0.1),
        "white_balance.log": mi.Float(0.1, 0.5, 0.8, 0.6, 0.6, 0.4),
    }
    model.assign(model.slowed(before, after))
    logs = np.log(model.gains())
    np.testing.assert_allclose(logs[:, 1], [0, 0.14, -0.06], atol=1e-6)
    balance = logs[:, [0, 2]] - logs[:, [1]]
    np.testing.assert_allclose(balance, [[0, 0], [0.16, 0.1], [-0.04, -0.1]], atol=1e-6)


@pytest.mark.parametrize("balance", ["known", "common"])
def test_an_only_image_and_what_images_share_move_as_steps_take_them(balance):
    model = CameraModel(1, exposure=True, white_balance=balance)
    steps = {key: x + 1 for key, x in model.parameters().items()}
    assert not CameraModel(1, exposure=True).slowed(model.parameters(), steps)
    assert "white_balance.log" not in model.slowed(model.parameters(), steps)


@pytest.mark.parametrize("pairs", [True, False], ids=["all pairs", "split halves"])
def test_a_gain_that_is_right_is_as_good_as_a_divided_photograph(pairs):
    """Also in the denominator, with its ε; and gradients of the gain are those of a square."""
    rng = np.random.default_rng(5)
    samples = mi.Color3f([mi.Float(rng.uniform(0, 1, 16).astype(np.float32)) for _ in range(3)])
    target = mi.Color3f([mi.Float(rng.uniform(0, 1, 4).astype(np.float32)) for _ in range(3)])
    reference = target * 0.9
    for primal in (None, pixel_means(samples * 1.1, 4)):
        plain = RelativeL2(0.1, reference, pairs=pairs).error(samples, target, 4, primal)
        gain = mi.Color3f(4, 2, 0.5) * dr.ones(mi.Float, 4)
        dr.enable_grad(gain)
        found = RelativeL2(0.1, reference * gain, gain=gain, pairs=pairs)
        error = found.error(samples, target * dr.detach(gain), 4, primal)
        assert float(error[0]) == pytest.approx(float(plain[0]), rel=1e-5)
        dr.backward(error)
        assert all((np.array(dr.grad(c)) != 0).all() for c in gain)
        known = found.of_known_camera()
        assert not dr.grad_enabled(known.error(samples, target, 4, primal))


def start(built_in, camera, **more):
    config = replace(TINY_FIT, camera=camera, **more)
    cameras = built_in_cameras("cornell", 8, views=2)
    views = [View(str(i), "train", c, Path(), {}) for i, c in enumerate(cameras)]
    problem = make_problem(built_in("cornell"), "visible", config, 0.2, views=views)
    return TrainingStep(problem, grey_photographs(cameras), config), initial_state(problem)


def rates(number):
    names = ("albedo", "roughness", "radiance", *EVERYTHING.unknowns)
    return dict.fromkeys(names, 2e-3 * 0.9**number)


@pytest.mark.parametrize("method", ["direct", pytest.param("ours", marks=pytest.mark.slow)])
def test_nothing_is_compiled_after_the_first_steps_and_all_but_responses_is_trained(
    built_in, method
):
    step, state = start(built_in, EVERYTHING, method=method)
    before = {key: np.array(value) for key, value in state.phi.items()}
    names = {key.partition(".")[0] for key in before}
    assert names == {"albedo", "roughness", *EVERYTHING.unknowns}
    assert step.rate_names == ("albedo", "roughness", *EVERYTHING.unknowns, "radiance")
    assert_only_replayed(step, state, rates)
    for key, value in state.phi.items():
        moved = (np.array(value) != before[key]).any()
        assert moved == ("response" not in key) and np.isfinite(np.array(value)).all(), key


@pytest.mark.parametrize("method", ["prb", "ad-pt"])
def test_methods_that_follow_paths_train_all_of_a_camera(unknown, method):
    everything = replace(EVERYTHING, poses="refined", intrinsics="refined")
    paths = replace(TINY_FIT.path, max_depth=3)
    config = replace(TINY_FIT, method=method, camera=everything, path=paths, steps=3)
    begun = begin_fit(Dataset.load(unknown), config)
    before = {key: np.array(value) for key, value in begun.state.phi.items()}
    names = {key.partition(".")[0] for key in before}
    assert names == {"albedo", "roughness", *everything.unknowns}
    for i in range(3):
        terms = begun.step(begun.state, i, learning_rates(begun.config, i, i / 3))
        assert float(terms["skipped"][0]) == 0
    for key, value in begun.state.phi.items():
        moved = (np.array(value) != before[key]).any()
        # Photographs have told the response before.
        assert moved == ("response" not in key) and np.isfinite(np.array(value)).all(), key


def test_a_bracket_is_fitted_as_it_is(cornell, tiny, tmp_path):
    data = shutil.copytree(cornell, tmp_path / "data")
    content = json.loads((data / "transforms.json").read_text())
    (frame,) = (f for f in content["frames"] if f["file_path"].endswith("train_000.exr"))
    pixels = read_exr(data / frame["file_path"])
    for name, exposure in (("dark", 0.25), ("bright", 4.0)):
        more = {"file_path": f"images/{name}.exr", "exposure": exposure, "clipped": 0.5}
        content["frames"].append(frame | more)
        exposed = np.minimum(pixels * [*[exposure] * 3, 1], [0.5, 0.5, 0.5, 1])
        write_exr(data / "images" / f"{name}.exr", exposed)
    (data / "transforms.json").write_text(json.dumps(content))
    dataset = Dataset.load(data)
    photographs = Photographs.load(dataset, False)
    places = {view.name: 256 * i for i, view in enumerate(dataset.train)}
    bright = photographs.radiance(np.arange(256) + places["bright"])
    true = photographs.radiance(np.arange(256) + places["train_000"])
    assert 0.02 < (true > 0.125).mean() < 0.98
    np.testing.assert_allclose(bright, np.minimum(true, 0.125), rtol=1e-5)
    settings = replace(read_toml(tiny), method="direct", steps=4)
    assert fit(data, tmp_path / "run", settings).step == 4
    log = RunFolder(tmp_path / "run").log()
    losses = [row["photometric"] for row in log if "photometric" in row]
    assert losses and np.isfinite(losses).all()


def test_what_is_off_costs_nothing(built_in, one_thread, monkeypatch):
    """A step without any of it has the loss of before, to the last bit."""

    def as_before(self, samples, target, spp, primal=None):
        assert (self.clipped, self.gain, primal) == (None, None, None)
        pixel = dr.arange(mi.UInt32, dr.width(samples)) // spp
        errors = samples - dr.gather(mi.Color3f, target, pixel)
        dr.eval(samples, errors)
        products = [
            dr.square(dr.block_sum(c, spp)) - dr.block_sum(dr.square(c), spp) for c in errors
        ]
        products = mi.Color3f([c / (spp * (spp - 1)) for c in products])
        weight = dr.rcp(dr.square(self.reference) + self.epsilon)
        return dr.mean(dr.mean(products * weight))

    found = []
    for number in range(2):
        if number:
            monkeypatch.setattr(RelativeL2, "error", as_before)
        step, state = start(built_in, CameraConfig(), estimator="all-pairs")
        assert step.batch_loss.inputs(0).exposures is None and step._problem.camera is None
        terms = [step(state, i, rates(i)) for i in range(2)]
        of_terms = {k: float(v[0]) for t in terms for k, v in t.items()}
        found.append((of_terms, parameters_of(state)))
    assert found[0][0] == found[1][0]
    for key, value in found[0][1].items():
        np.testing.assert_array_equal(value, found[1][1][key])


def test_cameras_need_the_views_that_they_took(built_in):
    config = replace(TINY_FIT, camera=EVERYTHING)
    with pytest.raises(ValueError, match="give the training views"):
        make_problem(built_in("cornell"), "visible", config, 0.2)


# -------------------------------------------------------------------------------- unknown exposures

UNTOLD = (1.5, 0.4, 2.5)


@pytest.fixture(scope="module")
def unknown(cornell, tmp_path_factory):
    """The room, each photograph with an exposure that nobody tells."""
    data = shutil.copytree(cornell, tmp_path_factory.mktemp("unknown") / "data")
    return expose(data, UNTOLD, told=False)


def test_exposures_begin_at_what_photographs_say_of_the_same_points(unknown, exposed):
    for data, truth in ((unknown, UNTOLD), (exposed, (1, 1))):
        dataset = Dataset.load(data)
        pixels = training_pixels(dataset, clip_negative=False)
        scene = parse(dataset.scene, dataset.root).instantiate()
        gains = first_gains(shared_points(scene, dataset.train, pixels))
        assert gains.shape == (2, 3) and (gains[0] == 1).all()
        np.testing.assert_allclose(np.log2(gains[1]), np.log2(truth[1] / truth[0]), atol=0.15)


VALUES = np.linspace(0, 1, 2000)
#: Log noise of photographs, and the gains of their views: stops, and the share lost in corners.
NOISE, VIEWS, CORNER = 0.25, 24, 0.4


def photographed_points(rng, points, stops, corner=0.0, shine=0.0, kind="contrast"):
    """Points that up to eight views see, whose response is some curve, as `SeenPoints`.

    Every point is as noisy as path traced rooms are. What is clipped or dark is a bound.
    """
    view = np.array([rng.permutation(len(stops))[:8] for _ in range(points)]).ravel()
    point = np.repeat(np.arange(points), 8)
    light = np.exp(rng.normal(-2.5, 1, points))[point]
    radius2 = rng.uniform(0, 1, len(point))
    light *= 2.0 ** stops[view] * (1 - corner * radius2) * np.exp(rng.normal(0, NOISE, len(point)))
    light *= np.where(rng.uniform(size=len(point)) < shine, rng.uniform(2, 6, len(point)), 1)
    dark = 0.01 * light.mean()
    bound = (light >= 1).astype(int) - (light <= dark)
    logs = np.log(response(np.clip(light, dark, 1), kind))
    return SeenPoints(point, view, radius2, logs, np.log(2) * stops[view], bound)


def error_of_light(curve, values=VALUES):
    """Of light that a curve reads, as a share of white, at even places of code values."""
    places = np.linspace(0, 1, len(curve))
    truth = np.interp(places**2.2, response(values, "contrast"), values)
    return np.sqrt(((curve**2.2 - truth) ** 2).mean())


def ratio_of_light(curve):
    """What a curve reads over what it is, at code values that most of the photographs have."""
    places = np.linspace(0, 1, len(curve))
    truth = np.interp(places**2.2, response(VALUES, "contrast"), VALUES)
    return (curve[2:14] ** 2.2) / truth[2:14]


def test_a_response_begins_at_what_exposures_that_differ_say():
    """Noise of photographs makes no curve flatter, nor do shine and what is clipped or dark."""
    rng = np.random.default_rng(0)
    seen = photographed_points(rng, 6000, rng.uniform(-1.5, 1.5, VIEWS), shine=0.05)
    told = first_response(seen)
    assert told.gains is None and told.falloff is None
    np.testing.assert_allclose(ratio_of_light(told.curve), 1, atol=0.06)
    assert ratio_of_light(np.linspace(0, 1, len(told.curve))).min() < 0.6
    model = CameraModel(3, response=True)
    model.start_response(np.stack([told.curve] * 3))
    np.testing.assert_allclose(model.curves(), [told.curve] * 3, atol=1e-5)


def test_a_response_whose_middle_is_bright_is_told_by_known_exposures():
    """What is expected of white, which few photographs show, does not bend the curve below it."""
    rng = np.random.default_rng(3)
    seen = photographed_points(rng, 6000, rng.uniform(-1.5, 1.5, VIEWS), kind="lifted")
    curve = first_response(seen).curve
    places = np.linspace(0, 1, len(curve)) ** 2.2
    truth = np.interp(places, response(VALUES, "lifted"), VALUES)
    ratio = curve[2:-2] ** 2.2 / truth[2:-2]
    np.testing.assert_allclose(ratio / ratio[6], 1, atol=0.08)


def test_a_response_is_not_told_where_exposures_hardly_differ_or_nothing_is_shared():
    rng = np.random.default_rng(1)
    seen = photographed_points(rng, 500, rng.uniform(-0.05, 0.05, VIEWS))
    for some in (seen, seen.some(np.zeros(len(seen.point), bool))):
        told = first_response(some, VIEWS, vignetting=True)
        assert told.curve is None
        assert not told.gains.any() and not told.falloff.any()


def test_unknown_gains_and_vignetting_are_told_beside_the_response():
    rng = np.random.default_rng(2)
    stops = rng.uniform(-1.5, 1.5, VIEWS)
    seen = photographed_points(rng, 6000, stops, corner=CORNER)
    guess = rng.normal(0, 0.2, VIEWS) + np.log(2) * stops
    told = first_response(replace(seen, gains=guess[seen.view]), VIEWS, vignetting=True)
    found = guess + told.gains
    wrong = (found - found[0]) / np.log(2) - (stops - stops[0])
    assert told.gains[0] == 0 and np.sqrt(np.mean(wrong**2)) < 0.1
    np.testing.assert_allclose(ratio_of_light(told.curve), 1, atol=0.2)
    radius2 = np.linspace(0, 1, 9)
    falloff = np.exp(log_falloff(told.falloff, radius2))
    np.testing.assert_allclose(falloff, 1 - CORNER * radius2, atol=0.03)
    model = CameraModel(3, vignetting=True)
    model.start_vignetting(lambda r: 1 - CORNER * r)
    np.testing.assert_allclose(model.falloff(radius2), 1 - CORNER * radius2, atol=1e-5)


def test_a_response_that_photographs_do_not_tell_is_doubted_and_stays(cornell, tiny):
    config = replace(read_toml(tiny), camera=CameraConfig(response="monotone"))
    dataset = Dataset.load(cornell)  # of one exposure
    pixels = pixels_of(dataset, config, clip_negative=False)
    problem = problem_of(dataset, config, pixels.photographs.level)
    line = begin_cameras(problem, dataset, pixels)
    assert "exposures that differ tell it: it is taken as known" in line
    np.testing.assert_allclose(problem.camera.curves(), [np.linspace(0, 1, 17)] * 3, atol=1e-6)


@pytest.mark.parametrize(
    "unknown", [{"exposure": "per-image"}, {"white_balance": "per-image"}, {"response": "monotone"}]
)
def test_one_photograph_tells_nothing_of_its_camera(unknown, cornell, tiny):
    config = replace(read_toml(tiny), camera=CameraConfig(**unknown))
    dataset = Dataset.load(cornell)
    dataset = replace(dataset, views=(dataset.train[0], *dataset.heldout))
    pixels = pixels_of(dataset, config, clip_negative=False)
    problem = problem_of(dataset, config, pixels.photographs.level)
    line = begin_cameras(problem, dataset, pixels)
    assert (line is not None) == ("response" in unknown)
    np.testing.assert_allclose(problem.camera.gains(), np.ones((1, 3)))


def test_green_tells_the_response_where_each_photograph_has_a_white_balance(monkeypatch):
    """Red and blue alone would be explained by no response at all, with other balances."""
    rng, views = np.random.default_rng(0), 12
    stops, balance = rng.uniform(-1.5, 1.5, views), rng.uniform(-0.5, 0.5, (views, 3))
    balance -= balance[:, [1]]
    first, second = np.nonzero(~np.eye(views, dtype=bool))
    first, second = (np.repeat(x, 200) for x in (first, second))
    light = np.exp(rng.normal(-2, 1, (len(first), 3)))
    photographs = np.stack(
        [
            light * 2.0 ** (stops[v, None] + balance[v]) * np.exp(rng.normal(0, 0.02, light.shape))
            for v in (first, second)
        ]
    )
    read = np.maximum(response(np.minimum(photographs, 1), "contrast"), 1e-4)
    told = np.log(2) * stops
    logs = np.log(read) - told[np.stack([first, second])][..., None]
    away, bound = np.zeros(logs.shape[:2]), (photographs >= 1).astype(int)
    points = np.arange(len(first))
    shared = SharedPoints(points, first, second, away, logs, bound, np.zeros((views, 3)))
    monkeypatch.setattr(first_gains_module, "shared_points", lambda *_: shared)
    camera = CameraModel(views, white_balance="per-image", response=True)
    train = [SimpleNamespace(name=str(i), exposure=float(2.0**x)) for i, x in enumerate(stops)]
    problem = SimpleNamespace(camera=camera, scene_view=SimpleNamespace(scene=None))
    assert begin_cameras(problem, SimpleNamespace(train=train), None) is None
    assert max(error_of_light(curve) for curve in camera.curves()) < 0.02
    found = np.log2(camera.gains())
    assert np.abs(found - (balance - balance[0])).max() < 0.1
    # Taken as linear, photographs tell other balances.
    taken = np.log2(first_gains(shared))
    assert np.abs(taken - taken[:, [1]] - (balance - balance[0])).max() > 0.2


def test_gains_of_views_are_the_least_squares_ones():
    whole = np.log([[1, 1, 1], [9, 9, 9], [3, 3, 3]])
    # Nothing is shared with the last view: what its photograph says as a whole has to do.
    count = 1000
    pair = np.zeros((2, count, 3))
    pair[1] = np.log([2, 4, 8])
    views = np.repeat([[0], [1]], count, 1)
    points = np.arange(count)
    shared = SharedPoints(points, *views, np.zeros((2, count)), pair, np.zeros(pair.shape), whole)
    np.testing.assert_allclose(first_gains(shared), [[1, 1, 1], [2, 4, 8], [3, 3, 3]], rtol=1e-3)


def test_points_are_looked_for_in_views_that_may_show_them():
    towards = [Camera.look_at([x, 0, 5], [0, 0, 0], [0, 1, 0], 40, 8, 8) for x in range(5)]
    away = [Camera.look_at([x, 0, 5], [x, 0, 9], [0, 1, 0], 40, 8, 8) for x in range(95)]
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (300, 3))
    found = _partners(0, [*towards, *away], points, np.random.default_rng(1))
    assert set(found) >= {1, 2, 3, 4} and 0 not in found
    assert len(set(found)) == len(found) == 24
    assert _partners(1, towards, points, np.random.default_rng(1)) == [0, 2, 3, 4]


@pytest.fixture(scope="module")
def fitted(unknown, tiny, tmp_path_factory):
    """A short fit of all that can be unknown of a camera, and its evaluation."""
    run = tmp_path_factory.mktemp("fitted") / "run"
    settings = replace(read_toml(tiny), method="direct", steps=60, camera=EVERYTHING)
    fit(unknown, run, replace(settings, held_aside=0.25))
    few = EvaluationSettings(spp=16, max_depth=6, train_views=1, truth=True)
    return run, evaluate(run, few, tell=lambda line: None)


@pytest.mark.parametrize("balance", ["known", "common", "per-image"])
@pytest.mark.parametrize("exposure", [True, False])
def test_the_limit_by_the_true_materials_does_not_depend_on_the_fit(balance, exposure, cornell):
    view = Dataset.load(cornell).train[1]
    rng = np.random.default_rng(0)
    radiance = rng.uniform(0.1, 1, (6, 6, 3))
    photograph = radiance * (1.5, 1.0, 0.8) * (0.25 if exposure else 1)
    found = []
    for start in (0.0, 1.0):
        model = CameraModel(2, exposure=exposure, white_balance=balance)
        model.assign({k: mi.Float(start, *x[1:]) for k, x in model.parameters().items()})
        cameras = Cameras(model, [view, view])
        found.append(cameras.own_gain(view, radiance, photograph))
    np.testing.assert_array_equal(*found)
    if balance != "known":
        np.testing.assert_allclose(photograph, radiance * found[0])
    elif exposure:
        np.testing.assert_allclose(found[0], 0.25)  # the median of all channels
    else:
        np.testing.assert_array_equal(found[0], 1)


def test_the_limit_in_an_evaluation_does_not_depend_on_the_fit(
    unknown, tiny, tmp_path, monkeypatch
):
    config = replace(read_toml(tiny), method="direct", steps=0)
    fit(unknown, tmp_path / "run", replace(config, camera=CameraConfig(exposure="per-image")))
    recovered = load_run(tmp_path / "run")
    monkeypatch.setattr("unbake.evaluation.evaluate.load_run", lambda *_, **__: recovered)
    settings, limits, scores = EvaluationSettings(spp=2, max_depth=3, truth=True), [], []
    for stops in (0.0, 2.0):
        recovered.problem.camera.assign({"exposure.log": mi.Float(0.0, stops)})
        found = evaluate(tmp_path / "run", settings, tell=lambda line: None)
        limits.append([row["true_render_psnr"] for row in found["per_view"]])
        scores.append(found["train"]["render_psnr"])
    assert limits[0] == limits[1] and scores[0] != scores[1]


def test_a_fit_finds_exposures_and_tells_them(fitted, tmp_path):
    run, found = fitted
    camera = found["camera"]
    assert camera["unknown"] == list(EVERYTHING.unknowns) and camera["anchor"] == "train_000"
    rows = {row["name"]: row for row in camera["images"]}
    assert rows["train_000"]["stops"] == 0 and rows["heldout_000"]["split"] == "heldout"
    truth = np.log2(UNTOLD[1] / UNTOLD[0])
    # With so much unknown and light after one bounce missing, it is no more than about there.
    assert rows["train_001"]["stops"] == pytest.approx(truth, abs=1)
    assert set(camera["vignetting"]) == {"a", "b", "c"}
    assert [len(camera["response"][c]) for c in ("red", "green", "blue")] == [17] * 3
    # Held-out photographs after their own exposure are about as dark as the rendering then is.
    for row in found["per_view"]:
        assert row["render_psnr"] > 12 and row["true_render_psnr"] > 12
    assert RunFolder(run).metrics()["camera"] == camera
    page = write_report([run], tmp_path / "report.html").read_text()
    assert "<h2>Cameras</h2>" in page and "train_001" in page and "after their own exposure" in page
    settings = RunFolder(run).settings()
    assert settings.camera == EVERYTHING and from_toml(to_toml(settings)) == settings
    assert {f"phi.{key}" for key in trained_model()[1]} <= last_state(run).keys()


def test_steps_move_exposures_to_where_photographs_have_them(unknown, tiny):
    """From both sides: materials stay grey, and exposures make up for that."""
    camera = CameraConfig(exposure="per-image")
    config = replace(read_toml(tiny), method="direct", camera=camera)
    ends = []
    for start in (-0.6, 0.6):
        begun = begin_fit(Dataset.load(unknown), config)
        begun.state.replace({"exposure.log": mi.Float(0, start)})
        rates = dict.fromkeys(learning_rates(begun.config, 0, 0.0), 0.0) | {"exposure": 0.2}
        for number in range(100):
            begun.step(begun.state, number, rates)
        anchor, other = np.array(begun.state.phi["exposure.log"])
        ends.append(other - anchor)
    assert abs(ends[1] - ends[0]) < 0.3, ends


def test_a_resumed_fit_goes_on_bit_for_bit(unknown, tiny, tmp_path, monkeypatch):
    settings = replace(read_toml(tiny), method="direct", steps=8, camera=EVERYTHING)
    whole, parts, _ = whole_and_in_parts(unknown, tmp_path, settings, monkeypatch)
    assert whole.keys() == parts.keys() and len(whole["phi.exposure.log"]) == 2
    for key, value in whole.items():
        assert np.array_equal(value, parts[key]), key


def test_the_command_line_says_what_is_unknown(unbake, unknown, tiny, tmp_path):
    words = ("--settings", tiny, "--method", "direct", "--steps", "0")
    options = ("--exposures", "per-image", "--white-balance", "common", "--response", "known")
    done = unbake("fit", unknown, "--out", tmp_path / "run", *words, *options)
    assert done.status == 0, done.err
    settings = RunFolder(tmp_path / "run").settings()
    assert settings.camera == CameraConfig("per-image", "common")
    refused = unbake("fit", unknown, "--out", tmp_path / "other", "--exposures", "free")
    assert refused.status == 2 and "--exposures" in refused.err


def test_an_estimate_that_is_not_finite_does_not_turn_off_the_exposure_of_its_view(cornell):
    view = Dataset.load(cornell).heldout[0]
    rng = np.random.default_rng(1)
    radiance = rng.uniform(0.2, 1, (50, 3))
    model = SimpleNamespace(
        white_balance="none",
        parameters=lambda: {"exposure.log": None},
        common_gain=lambda: np.ones(3),
        light=lambda x: x,
    )
    cameras = Cameras(model, ())
    photograph = 3 * view.exposure * radiance
    radiance[7] = np.nan
    np.testing.assert_allclose(cameras.gain(view, radiance, photograph), 3)
    np.testing.assert_array_equal(cameras.gain(view, radiance * np.nan, photograph), 1)
