"""Poses and intrinsics that are refined: how rays, photographs and views follow corrections."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import built_in_cameras, randomised, whole_and_in_parts

from unbake.config import CameraConfig, from_toml, read_toml, to_toml
from unbake.dataset.camera import Camera
from unbake.dataset.pixels import CameraRays, PixelSource
from unbake.dataset.small_views import pixel_rays, seen_along
from unbake.dataset.views import Dataset
from unbake.errors import UserError
from unbake.evaluation.evaluate import evaluate
from unbake.evaluation.placing import placed_view, told_of_place
from unbake.evaluation.rendering import render
from unbake.evaluation.renderings import render_camera
from unbake.evaluation.settings import EvaluationSettings, RenderSettings
from unbake.fields.arrays import from_numpy
from unbake.imaging.pictures import write_exr
from unbake.report.page import write_report
from unbake.scene import edit
from unbake.scene.parse import parse
from unbake.training.cameras import Cameras
from unbake.training.fresh_fit import begin_fit
from unbake.training.poses import PoseModel
from unbake.training.recovered import load_run
from unbake.training.run_folder import RunFolder
from unbake.training.schedule import learning_rates
from unbake.transport.vertex import SceneView

SIZE = 12


@pytest.fixture(scope="module")
def scene(built_in):
    parsed = parse(built_in("cornell"), None)
    edit.to_principled(parsed)
    return parsed.instantiate()


def start(scene, seed=None, **unknown):
    """Three cameras, and corrections of the first two: zero, or random ones of some pixels."""
    cameras = built_in_cameras("cornell", SIZE, views=3)
    model = PoseModel.of(scene, cameras[:2], **({"poses": True, "intrinsics": True} | unknown))
    if seed is not None:
        randomised(model, seed, 1)
    return cameras, model


def test_rays_follow_corrections_as_cameras_do(scene):
    cameras, model = start(scene, seed=1)
    found = model.cameras()
    for corrected, given in zip(found, cameras[:2], strict=True):
        assert np.abs(corrected.to_world - given.to_world).max() > 1e-2
    # Both views have the same intrinsics, and so the same corrections
    assert found[0].fl_x == found[1].fl_x != cameras[0].fl_x and found[0].cx != cameras[0].cx
    ((told, lens),) = model.intrinsics()
    assert told is cameras[0] and lens.fl_x == found[0].fl_x
    rays = CameraRays.of(cameras)
    placed = model.placed(rays)
    for expected, part in (([*found, cameras[2]], placed), (cameras, start(scene)[1].placed(rays))):
        ray = dr.detach(part).through(dr.arange(mi.UInt32, rays.pixels), mi.Point2f(0.5))
        origins, directions = pixel_rays(expected)
        np.testing.assert_allclose(np.array(ray.o).T, origins, atol=1e-5)
        np.testing.assert_allclose(np.array(ray.d).T, directions, atol=1e-5)
    # Another view has the intrinsics of the training views, and its own pose
    other = model.lens(cameras[2])
    assert other.fl_x == found[0].fl_x and (other.to_world == cameras[2].to_world).all()
    assert model.lens(replace(cameras[2], fl_x=77.0)).fl_x == 77.0


def test_a_correction_of_one_pixel_moves_what_is_seen_by_one(scene):
    camera = built_in_cameras("cornell", 64)[0]
    model = PoseModel.of(scene, [camera], poses=True, intrinsics=True)
    for entry, (key, index) in enumerate(
        [("poses.moves", 0), ("poses.moves", 1), ("poses.moves", 3), ("intrinsics.moves", 1)]
    ):
        arrays = {k: np.zeros(dr.width(v), np.float32) for k, v in model.parameters().items()}
        arrays[key][index] = 1
        model.assign({k: mi.Float(v) for k, v in arrays.items()})
        told = told_of_place(scene, camera, model.cameras()[0])
        assert told["pixels"] == pytest.approx(1, rel=0.6 if entry < 3 else 1e-6)
        assert (told["degrees"] > 0) == (entry < 2) and (told["shift"] > 0) == (entry == 2)
    turned = camera.moved(np.array([0, 0.02, 0]), np.array([0, 0, 0.3]))
    told = told_of_place(scene, camera, turned)
    assert told["degrees"] == pytest.approx(np.degrees(0.02), rel=1e-4)
    assert told["shift"] == pytest.approx(0.3)


def test_a_photograph_is_read_where_the_point_of_a_pixel_comes_to_lie(scene):
    """The gradient of the target is the photograph's slope times how far the point moves."""
    cameras, model = start(scene, seed=2)
    rays = CameraRays.of(cameras[:2])
    rng = np.random.default_rng(3)
    rgb, alpha = rng.uniform(0.2, 0.8, (rays.pixels, 3)), np.ones(rays.pixels)
    pixels = replace(
        PixelSource.of(cameras[:2], rgb, alpha, foreground_only=False), slopes=True
    ).draw(5, 64)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, 2 * pixels.count)
    placed = model.placed(rays)
    batch = pixels.batch(dr.detach(placed), sampler, 2)
    target = model.target(scene, placed, pixels, batch)
    numbers, colours = pixels.read()
    np.testing.assert_allclose(np.array(target).T, colours[:, :3], atol=1e-6)
    weight = rng.normal(size=(64, 3)).astype(np.float32)
    dr.backward(dr.sum(dr.sum(target * mi.Color3f([mi.Float(w) for w in weight.T]))))
    arrays = model.parameters()
    gradients = {key: np.array(dr.grad(value)) for key, value in arrays.items()}

    # The same by differences of projections
    assert batch.slopes is not None
    slopes = np.stack([np.array(s).T for s in batch.slopes], -1)
    views = numbers // SIZE**2
    y, x = np.divmod(numbers % SIZE**2, SIZE)
    found = model.cameras()
    lit = [found[v].rays(x[[i]] + 0.5, y[[i]] + 0.5) for i, v in enumerate(views)]
    origins, directions = (np.concatenate(part) for part in zip(*lit, strict=True))
    distance = seen_along(scene, origins, directions).distance
    assert np.isfinite(distance).all()
    points = origins + directions * distance[:, None]

    def value(moved):
        model.assign({k: mi.Float(v.astype(np.float32)) for k, v in moved.items()})
        cameras = model.cameras()
        places = [cameras[v].project(points[[i]])[0] for i, v in enumerate(views)]
        return np.einsum("nc,nca,na->", weight, slopes, np.array(places))

    values = {key: np.array(dr.detach(array), np.float64) for key, array in arrays.items()}
    for key, gradient in gradients.items():
        for i in range(len(gradient)):
            step = np.zeros(len(gradient))
            step[i] = 1 / 64
            sides = [value(values | {key: values[key] + s * step}) for s in (1, -1)]
            expected = 32 * (sides[0] - sides[1])
            assert gradient[i] == pytest.approx(expected, rel=0.01, abs=0.01), (key, i)


def test_slopes_are_those_of_pixels_that_count():
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 60, 6, 5)
    row, column = np.divmod(np.arange(60) % 30, 6)
    rgb = np.stack([3.0 * column, 2.0 * row, 1.0 * column * row], 1)
    alpha = np.ones(60)
    alpha[30 + 6 * 2 + 3] = 0  # in the second view, row 2, column 3
    source = replace(
        PixelSource.of([camera] * 2, rgb, alpha, foreground_only=True),
        slopes=True,
        limits=np.array([9.0, 12.0], np.float32),
    )
    drawn = source.draw(0, 400)
    numbers, colours = drawn.read()
    np.testing.assert_array_equal(colours[:, :3], rgb[numbers].astype(np.float32))
    limits = np.where(numbers < 30, 9, 12)[:, None]
    np.testing.assert_array_equal(drawn.read_clipped(), rgb[numbers] >= limits)
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(0, drawn.count)
    batch = drawn.batch(source.rays, sampler, 1)
    np.testing.assert_array_equal(np.array(batch.clipped).T, rgb[numbers] >= limits)
    assert batch.slopes is not None
    across, down = (np.array(slope).T for slope in batch.slopes)
    x, y, second = column[numbers], row[numbers], numbers >= 30
    inner = (0 < x) & (x < 5) & ~(second & (y == 2) & np.isin(x, (2, 4)))
    np.testing.assert_allclose(across, inner[:, None] * np.stack([3 + 0 * x, 0 * x, y], 1))
    inner = (0 < y) & (y < 4) & ~(second & (x == 3) & np.isin(y, (1, 3)))
    np.testing.assert_allclose(down, inner[:, None] * np.stack([0 * x, 2 + 0 * x, x], 1))


def test_the_prior_weighs_as_much_as_pixels_are_left_unexplained(scene):
    _, model = start(scene, seed=4, intrinsics=False)
    squares = float((np.array(dr.detach(model.parameters()["poses.moves"])) ** 2).sum())
    value = model.prior(0.5, mi.Float(0.02), 100)
    assert float(value[0]) == pytest.approx(0.02 * squares / 0.25 / 100, rel=1e-5)
    assert float(model.prior(0.5, None, 100)[0]) == pytest.approx(squares / 25, rel=1e-5)
    assert float(model.prior(0.5, mi.Float(np.nan), 100)[0]) == 0


def test_a_view_is_moved_to_where_its_photograph_was_taken(cornell, tmp_path):
    """With the true materials, whose picture then differs by its place and by noise alone."""
    dataset = Dataset.load(cornell)
    parsed = parse(dataset.scene, dataset.root)
    edit.to_principled(parsed)
    own = SceneView.of(parsed.instantiate(), None, 0)
    settings = EvaluationSettings(spp=64, max_depth=3)
    camera = dataset.heldout[0].camera.rescaled(32, 32)
    photograph = render_camera(own, camera, settings, False)
    write_exr(tmp_path / "view.exr", np.dstack([photograph, np.ones((32, 32, 1))]))
    view = replace(dataset.heldout[0], camera=camera, image=tmp_path / "view.exr")
    train = [v.camera for v in dataset.train]
    model = PoseModel.of(own.scene, train, poses=True, intrinsics=False)
    turn, shift = model.units_of(own.scene, camera)
    off = camera.moved(turn * np.array([0.6, -0.5, 0.4]), shift * np.array([0.3, 0, 0]))
    recovered: Any = SimpleNamespace(
        problem=SimpleNamespace(poses=model, scene_view=own, hide_emitters=False),
        dataset=dataset,
        config=SimpleNamespace(camera=CameraConfig(poses="refined")),
        clip_negative=False,
    )
    cameras = Cameras(None, dataset.train)
    found = placed_view(recovered, cameras, replace(view, camera=off), settings)
    before, after = (told_of_place(own.scene, camera, c)["pixels"] for c in (off, found.camera))
    assert before > 0.8 and after < 0.4 * before, (before, after)
    # Training views have what was fitted, and given poses stay
    (first, *_) = dataset.train
    placed = placed_view(recovered, cameras, first, settings)
    assert (placed.camera.to_world == first.camera.to_world).all()
    recovered.problem.poses = None
    assert placed_view(recovered, cameras, view, settings) is view


def test_a_fit_corrects_poses_tells_them_and_goes_on_bit_for_bit(
    cornell, tiny, tmp_path, monkeypatch
):
    camera = CameraConfig(poses="refined", intrinsics="refined")
    settings = replace(read_toml(tiny), method="direct", steps=8, camera=camera)
    whole, parts, step = whole_and_in_parts(cornell, tmp_path, settings, monkeypatch)
    assert step.recordings() <= 3
    assert len(whole["phi.poses.moves"]) == 12 and len(whole["phi.intrinsics.moves"]) == 3
    for key, value in whole.items():
        assert np.array_equal(value, parts[key]), key
    assert (whole["phi.poses.moves"] != 0).all() and (whole["phi.intrinsics.moves"] != 0).all()

    run, few = tmp_path / "whole", EvaluationSettings(spp=4, max_depth=3, train_views=1)
    found = evaluate(run, few, tell=lambda line: None)["camera"]
    assert found["unknown"] == ["poses", "intrinsics"] and "anchor" not in found
    rows = {row["name"]: row for row in found["images"]}
    poses, views = load_run(run).problem.poses, Dataset.load(cornell).train
    assert poses is not None
    corrected = poses.cameras()
    for view, moved in zip(views, corrected, strict=True):
        row = rows[view.name]
        assert row["pixels"] > 0 and row["degrees"] > 0 and row["shift"] > 0
        np.testing.assert_array_equal(row["transform_matrix"], moved.to_world)
    assert rows["heldout_000"]["split"] == "heldout"
    wanted = RenderSettings(spp=1, max_depth=2, views="all")
    again = render(run, tmp_path / "pictures", wanted, tell=lambda line: None)
    shown = {frame["name"]: frame for frame in again["frames"]}
    for view, moved in zip(views, corrected, strict=True):
        np.testing.assert_allclose(shown[view.name]["transform_matrix"], moved.to_world, rtol=1e-6)
        assert shown[view.name]["fl_x"] == pytest.approx(moved.fl_x, rel=1e-6)
    assert shown["heldout_000"]["fl_x"] == pytest.approx(corrected[0].fl_x, rel=1e-6)
    (lens,) = found["intrinsics"]
    assert lens["fl_x"] == corrected[0].fl_x != lens["told_fl_x"] == views[0].camera.fl_x
    assert RunFolder(run).metrics()["camera"] == found
    page = write_report([run], tmp_path / "report.html").read_text()
    assert "Moved, pixels" in page and "intrinsics: focal length" in page


def test_steps_move_poses_to_where_photographs_have_them(cornell, tiny):
    """From both sides, and next to nothing is known of them beforehand."""
    camera = CameraConfig(poses="refined", pose_sigma=1e3)
    config = replace(read_toml(tiny), method="direct", camera=camera)
    dataset, starts, ends = Dataset.load(cornell), [], []
    for start in (-1.0, 1.0):
        begun = begin_fit(dataset, config)
        moves = np.zeros((2, 6), np.float32)
        moves[:, :2] = start  # turned about the horizontal and the vertical axis, pixels
        begun.state.replace({"poses.moves": from_numpy(mi.Float, moves.ravel())})
        begun.state.publish(begun.problem)
        starts.append(begun.problem.poses.cameras())
        rates = dict.fromkeys(learning_rates(begun.config, 0, 0.0), 0.0) | {"poses": 0.02}
        for number in range(150):
            begun.step(begun.state, number, rates)
        begun.state.publish(begun.problem)
        ends.append(begun.problem.poses.cameras())

    def apart(both):
        scene = parse(dataset.scene, dataset.root).instantiate()
        return np.mean([told_of_place(scene, *pair)["pixels"] for pair in zip(*both, strict=True)])

    assert apart(starts) > 2
    assert apart(ends) < 0.5 * apart(starts), (apart(starts), apart(ends))


def test_the_command_line_says_what_is_refined(unbake, cornell, tiny, tmp_path):
    words = ("--settings", tiny, "--method", "direct", "--steps", "0")
    options = ("--poses", "refined", "--intrinsics", "refined", "--pose-sigma", "0.5")
    done = unbake("fit", cornell, "--out", tmp_path / "run", *words, *options)
    assert done.status == 0, done.err
    settings = RunFolder(tmp_path / "run").settings()
    assert settings.camera == CameraConfig(poses="refined", intrinsics="refined", pose_sigma=0.5)
    assert from_toml(to_toml(settings)) == settings


def test_uncertainties_that_are_none_are_refused():
    with pytest.raises(UserError, match="pose_sigma"):
        CameraConfig(pose_sigma=0)
