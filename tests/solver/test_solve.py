"""The forward problem: the radiance of known scenes, from the residual alone."""

import json
import os
import re
import shutil
import signal
from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from rich.console import Console
from safetensors.numpy import load_file, save_file
from support import TINY, assert_only_replayed, seeded

from unbake.config import FitConfig, read_toml
from unbake.config.light import LightConfig
from unbake.dataset.camera import LookAt
from unbake.dataset.views import Dataset
from unbake.errors import UserError
from unbake.fields.domain import Domain
from unbake.fields.radiance import make_radiance
from unbake.fields.settings import GridConfig, NetworkConfig
from unbake.imaging.pictures import read_exr, write_exr
from unbake.io import read_object
from unbake.scene.geometry import differing, probe
from unbake.solver import learn
from unbake.solver import solve as solving
from unbake.solver.lit import matching_scale
from unbake.solver.pictures import broken_pixels, debiased_relative_mse, relative_mse
from unbake.solver.points import SurfacePoints
from unbake.solver.settings import SolveSettings
from unbake.solver.solve import fine_tune, solve
from unbake.solver.step import SolverStep
from unbake.training import beginning
from unbake.training.loop import fit
from unbake.training.recovered import load_run
from unbake.training.run_folder import RunFolder
from unbake.training.solved import load_radiance, read_solved
from unbake.training.warm_start import start_radiance, with_solved_field
from unbake.transport.vertex import SceneView, find_vertex

SMALL = NetworkConfig(
    grid=GridConfig(levels=2, features=2, table_log2=10, base_resolution=2), width=16, hidden=1
)
SETTINGS = SolveSettings(
    steps=400, batch=1024, samples=2, views=2, resolution=8, spp=16, final_spp=64, reference_spp=8,
    radiance=SMALL,
)  # fmt: skip
TRUTH = 2.0  # 1 / (1 - 0.5), the radiance in the furnace


@pytest.fixture(scope="module")
def solved(tmp_path_factory):
    """The furnace, solved; the folder and what was told."""
    out, lines = tmp_path_factory.mktemp("solved") / "out", []
    solve("furnace", out, SETTINGS, tell=lines.append)
    return out


def test_the_radiance_in_a_furnace_is_found_within_one_percent(solved):
    for side in ("lhs", "rhs"):
        error = np.stack([read_exr(solved / f"train_00{i}-{side}.exr") for i in (0, 1)]) / TRUTH - 1
        print(f"{side}: mean {error.mean():+.4f}, rms {np.sqrt(np.mean(error**2)):.4f}")
        assert abs(error.mean()) < 0.01
        # A pixel of RHS keeps the noise of its 64 bounces.
        assert np.sqrt(np.mean(error**2)) < (0.01 if side == "lhs" else 0.03)


@pytest.mark.parametrize("unit", [1e-5, 1e5])
def test_the_unit_of_light_does_not_matter(unit, solved, built_in, tmp_path):
    """Dim scenes were within epsilon, and bright ones were fitted to the noise of dark corners."""
    text = built_in("furnace").read_text()
    (given,) = re.findall(r'name="radiance" value="([^"]*)"', text)
    value = " ".join(str(unit * float(x)) for x in given.replace(",", " ").split())
    shutil.copytree(built_in("furnace").parent, tmp_path / "scene")
    scene = tmp_path / "scene" / built_in("furnace").name
    scene.write_text(text.replace(f'"{given}"', f'"{value}"'))
    look = {"origin": [0, 0, 0], "target": [1, 0.2, 0.1], "up": [0, 0, 1], "fov": 60}
    cameras = tmp_path / "cameras.json"
    cameras.write_text(json.dumps([look]))
    solve(scene, tmp_path / "out", SETTINGS, cameras=cameras, tell=lambda line: None)
    read = read_object(tmp_path / "out" / "solve.json")["measurements"]
    error = read_exr(tmp_path / "out" / "train_000-lhs.exr") / (unit * TRUTH) - 1
    assert abs(error.mean()) < 0.02
    assert read[0]["relmse"]["lhs"] > 10 * read[-1]["relmse"]["lhs"]


def test_the_untrained_field_did_not_know_it(solved):
    first, *_, last = read_object(solved / "solve.json")["measurements"]
    assert (first["step"], last["step"]) == (0, SETTINGS.steps)
    assert first["relmse"]["lhs"] > 10 * last["relmse"]["lhs"]
    assert first["cpu_seconds"] == 0 < last["cpu_seconds"]
    assert last["pictures_seconds"] > 0 < last["pictures_cpu_seconds"]
    assert (first["spp"], last["spp"]) == (SETTINGS.spp, SETTINGS.final_spp)


def test_noise_of_the_reference_can_be_taken_out_of_an_error():
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.5, 2, (64, 64, 3))
    halves = [[truth + 0.05 * rng.standard_normal(truth.shape)] for _ in range(2)]
    reference = [(halves[0][0] + halves[1][0]) / 2]
    off = [truth + 0.03 * rng.choice([-1, 1], truth.shape)]
    true = relative_mse(off, [truth])
    assert debiased_relative_mse(off, halves) == pytest.approx(true, rel=0.1)
    assert relative_mse(off, reference) > 2 * true
    assert abs(debiased_relative_mse([truth], halves)) < 0.1 * true


def test_pixels_that_are_not_finite_are_left_out_of_an_error():
    rng = np.random.default_rng(0)
    reference = [rng.uniform(0.5, 2, (8, 8, 3)) for _ in range(2)]
    pictures = [x + 0.1 * rng.standard_normal(x.shape) for x in reference]
    halves = [[x + 0.1 * sign for x in reference] for sign in (1, -1)]
    errors = relative_mse(pictures, reference), debiased_relative_mse(pictures, halves)
    assert broken_pixels(pictures) == 0
    pictures[0][3, 5, 1], pictures[1][0, 0] = np.nan, np.inf
    reference[1][7, 2, 0] = halves[1][1][7, 2, 2] = -np.inf
    assert broken_pixels(pictures) == 2 and broken_pixels(reference) == 1
    found = relative_mse(pictures, reference), debiased_relative_mse(pictures, halves)
    assert found == pytest.approx(errors, rel=0.2)
    assert np.isnan(relative_mse([np.full((2, 2, 3), np.nan)], [np.ones((2, 2, 3))]))


def test_what_is_written_is_told_and_can_be_read_again(solved):
    told = read_object(solved / "solve.json")
    assert told["finished"] and told["reference_noise"] > 0
    pictures = [read_exr(solved / f"train_00{i}-reference.exr") for i in (0, 1)]
    left = [read_exr(solved / f"train_00{i}-lhs.exr") for i in (0, 1)]
    stated = told["measurements"][-1]["relmse"]["lhs"]
    assert stated == pytest.approx(relative_mse(left, pictures), rel=1e-4)
    assert {"step", "residual", "seconds"} <= json.loads(
        (solved / "progress.jsonl").read_text().splitlines()[-1]
    ).keys()
    for name in ("train_000-lhs.png", "train_001-rhs.png", "train_000-reference.png"):
        assert (solved / name).stat().st_size > 0

    radiance = load_radiance(solved)
    p = mi.Point3f([0.3, -1.0], [1.0, 0.2], [-0.4, 0.1])
    n = mi.Normal3f([0, 1.0], [-1.0, 0], [0, 0])
    found = radiance.evaluate(p, mi.Vector3f(n), n, mi.Color3f(0.5), mi.Bool(True))
    # Reflected light alone: emission is added analytically.
    np.testing.assert_allclose(np.array(found), TRUTH - 1, rtol=0.05)


def test_a_field_of_before_does_not_leak(solved, tmp_path):
    shutil.copy(solved / "radiance.safetensors", tmp_path)
    told = read_object(solved / "solve.json")
    del told["radiance"]["settings"]["leak"]
    (tmp_path / "solve.json").write_text(json.dumps(told))
    assert read_solved(tmp_path).settings.leak == 0


def test_a_field_of_before_was_written_with_its_last_measurement(solved, tmp_path):
    shutil.copy(solved / "radiance.safetensors", tmp_path)
    told = read_object(solved / "solve.json")
    assert told.pop("step") == SETTINGS.steps == read_solved(solved).steps
    told["measurements"][-1]["step"] = 390
    (tmp_path / "solve.json").write_text(json.dumps(told))
    assert read_solved(tmp_path).steps == 390


def test_a_damaged_folder_is_refused(solved, tmp_path):
    (tmp_path / "solve.json").write_text((solved / "solve.json").read_text())
    with pytest.raises(UserError, match="does not exist"):
        load_radiance(tmp_path)
    (tmp_path / "radiance.safetensors").write_bytes(b"damaged")
    with pytest.raises(UserError, match="no field"):
        load_radiance(tmp_path)
    with pytest.raises(UserError, match="no solved radiance field"):
        load_radiance(tmp_path / "other")


@pytest.mark.parametrize("attach", [False, True])
def test_a_step_is_replayed_and_lowers_the_residual(built_in, attach):
    scene = mi.load_file(str(built_in("furnace")))
    settings = replace(SETTINGS, attach_rhs=attach, batch=512)
    radiance = make_radiance("neural", TINY, Domain.of(scene.bbox()), scale=3.0, seed=1)
    adam = mi.ad.Adam(0.01, radiance.parameters(), mask_updates=True)
    points = SurfacePoints.of(scene)
    step = SolverStep(SceneView.of(scene, None, 8), radiance, points, settings)
    first = float(step(adam, 0, 0.01)["residual"][0])
    assert_only_replayed(step, adam, lambda i: 0.01, steps=40)
    last = float(step(adam, 99, 0.01)["residual"][0])
    assert last < 0.5 * first


@pytest.mark.parametrize("of_material", [False, True])
def test_a_step_with_a_field_that_cannot_be_recorded_is_traced_each_time(built_in, of_material):
    """Such as a PyTorch module: what is replayed would have the gradients of the first step."""
    scene = mi.load_file(str(built_in("furnace")))
    radiance = make_radiance("neural", TINY, Domain.of(scene.bbox()), scale=3.0, seed=1)
    if not of_material:
        radiance.function.recordable = False
    problem = SimpleNamespace(
        fields=lambda: [SimpleNamespace(recordable=not of_material)], assign=lambda arrays: None
    )
    adam = mi.ad.Adam(0.01, radiance.parameters(), mask_updates=True)
    view, points = SceneView.of(scene, None, 8), SurfacePoints.of(scene)
    step = SolverStep(view, radiance, points, replace(SETTINGS, batch=512), problem)
    residuals = [float(step(adam, i, 0.01)["residual"][0]) for i in range(15)]
    assert step.recordings() == 0
    assert residuals[-1] < 0.7 * residuals[0]


def test_gradients_of_the_right_hand_side_pass_only_where_it_is_attached(built_in):
    """Of a constant field in the furnace: L − ρ (E + L), by L, is 1, or 1 − ρ if attached."""
    scene = mi.load_file(str(built_in("furnace")))
    found = {}
    for attach in (False, True):

        class Constant:
            scale = 1.0

            value = mi.Float(3.0)

            function = SimpleNamespace(recordable=True)

            def evaluate(self, p, w, n, albedo, valid, engine=None):
                return dr.select(valid, mi.Color3f(self.value), 0)

        field = Constant()
        dr.enable_grad(field.value)
        settings = replace(SETTINGS, attach_rhs=attach, batch=1 << 14, samples=4)
        step = SolverStep(SceneView.of(scene, None, 8), field, SurfacePoints.of(scene), settings)
        inputs = step.inputs(0)
        dr.backward(step.loss(inputs))
        found[attach] = float(dr.sum(dr.grad(field.value))[0])
    np.testing.assert_allclose(found[True] / found[False], 0.5, rtol=0.03)


SHAPES = """<scene version="3.0.0">
  <bsdf type="diffuse" id="grey"/>
  <shape type="rectangle" id="both"><bsdf type="twosided"><ref id="grey"/></bsdf>
    <transform name="to_world"><translate x="-4"/></transform></shape>
  <shape type="rectangle" id="front"><ref id="grey"/></shape>
  <shape type="sphere" id="ball"><ref id="grey"/><point name="center" x="4" y="0" z="0"/></shape>
  <shape type="rectangle" id="black"><bsdf type="diffuse"><rgb name="reflectance" value="0"/></bsdf>
    <transform name="to_world"><translate x="-8"/></transform></shape>
  <shape type="shapegroup" id="group"><shape type="rectangle"><ref id="grey"/></shape></shape>
  <shape type="instance"><ref id="group"/><transform name="to_world"><scale value="2"/>
    <rotate y="1" angle="180"/><translate x="9"/></transform></shape>
  <emitter type="constant"/>
</scene>
"""


def test_points_lie_on_all_sides_that_scatter_by_their_area():
    scene = mi.load_string(SHAPES)
    points = SurfacePoints.of(scene)
    lanes = 1 << 16
    ray = points.rays(seeded(3, lanes))
    vertex = find_vertex(SceneView.of(scene, None, 8), ray, mi.Bool(True), seeded(4, lanes))
    valid, w = np.array(vertex.valid), np.array(vertex.w)
    p, n = np.array(vertex.si.p), np.array(vertex.si.n)
    assert valid.mean() > 0.999
    cosine = (w * n).sum(0)
    where = np.digitize(p[0], [-6, -2, 2, 6])  # black, both, front, ball, instance
    areas = np.array([0, 8, 4, 4 * np.pi, 16])
    np.testing.assert_allclose(
        np.bincount(where, minlength=5) / lanes, areas / areas.sum(), atol=0.01
    )
    assert abs((cosine[where == 1] > 0).mean() - 0.5) < 0.02
    assert all((cosine[where == i] > 0).mean() > 0.999 for i in (2, 3, 4))
    # Uniform over the hemisphere: the cosine has a mean of a half; by cosine it would be 2/3.
    assert abs(cosine[where == 4].mean() - 0.5) < 0.01
    assert (n[2][where == 4] < 0).mean() > 0.999


def test_a_scene_that_scatters_nothing_is_refused():
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "bsdf": black}})
    with pytest.raises(UserError, match="nothing in the scene scatters"):
        SurfacePoints.of(scene)


def test_the_command_writes_the_folder_and_fits_eighty_columns(unbake, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    words = ["--steps", 3, "--batch", 64, "--views", 1, "--resolution", 8, "--spp", 4]
    done = unbake("solve", "furnace", "--out", tmp_path / "s", *words, "--reference-spp", 4)
    assert done.status == 0, done.err
    assert max(map(len, done.out.splitlines()[:-1])) <= 80
    assert "relMSE of LHS" in done.out
    assert (tmp_path / "s" / "train_000-rhs.exr").is_file()
    again = unbake("solve", "furnace", "--out", tmp_path / "s", *words)
    assert again.status == 2 and "not empty" in again.err


def test_pictures_of_a_solve_have_the_names_of_a_camera_file(tmp_path):
    camera = {"name": "corner", "origin": [0.9, 0.9, 0.9], "target": [0, 0, 0], "up": [0, 0, 1]}
    (tmp_path / "cameras.json").write_text(json.dumps([camera | {"fov": 75}]))
    settings = SolveSettings(steps=3, batch=64, views=1, resolution=8, spp=4, final_spp=4,
                             reference_spp=0, radiance=SMALL)  # fmt: skip
    made = solve("furnace", tmp_path / "out", settings, cameras=tmp_path / "cameras.json")
    assert made["views"] == ["corner"] and (tmp_path / "out" / "corner-rhs.exr").is_file()


def test_a_solve_that_is_stopped_keeps_all_that_was_learned(tmp_path, monkeypatch):
    """A signal comes while the clock waits for the steps, far from a measurement."""
    taken, sent = [], []
    step, sync = SolverStep.__call__, dr.sync_thread

    def counted(self, *args):
        taken.append(1)
        return step(self, *args)

    def interrupted():
        if len(taken) > 30 and not sent:
            sent.append(os.kill(os.getpid(), signal.SIGINT))
        sync()

    monkeypatch.setattr(SolverStep, "__call__", counted)
    monkeypatch.setattr(learn.dr, "sync_thread", interrupted)
    settings = SolveSettings(steps=400, batch=64, views=1, resolution=8, spp=4, final_spp=8,
                             reference_spp=0, radiance=SMALL)  # fmt: skip
    made = solve("furnace", tmp_path / "out", settings)
    *_, last = made["measurements"]
    assert sent and 30 < len(taken) < 60 and last["step"] == len(taken)
    assert made["finished"] is False
    assert last["spp"] == 4 < settings.final_spp, "whoever stops it does not wait for the others"
    assert read_object(tmp_path / "out" / "solve.json")["measurements"][-1] == last


SHORT = SolveSettings(
    steps=64, batch=64, views=1, resolution=8, spp=4, final_spp=8, reference_spp=0, radiance=SMALL
)


class Killed(Exception):
    """In the place of the end of the process."""


def test_what_was_learned_is_written_before_the_last_pictures(tmp_path, monkeypatch):
    """They may take hours; whoever ends them must not lose the training."""
    rendered = learn.both_sides

    def killed(scene_view, radiance, cameras, spp, seed, **more):
        if spp == SHORT.final_spp:
            raise Killed
        return rendered(scene_view, radiance, cameras, spp, seed, **more)

    monkeypatch.setattr(learn, "both_sides", killed)
    with pytest.raises(Killed):
        solve("furnace", tmp_path / "out", SHORT)
    told = read_object(tmp_path / "out" / "solve.json")
    assert told["step"] == SHORT.steps and not told["finished"]
    assert told["measurements"][-1]["step"] < SHORT.steps
    assert read_solved(tmp_path / "out").steps == SHORT.steps


def test_whoever_stops_it_does_not_wait_for_the_last_pictures(tmp_path, monkeypatch):
    asked = []

    def rendered(scene_view, radiance, cameras, spp, seed, *, ended, **more):
        if spp == SHORT.final_spp:
            os.kill(os.getpid(), signal.SIGINT)
        asked.append((spp, ended()))
        return both_sides(scene_view, radiance, cameras, spp, seed, ended=ended, **more)

    both_sides = learn.both_sides
    monkeypatch.setattr(learn, "both_sides", rendered)
    made = solve("furnace", tmp_path / "out", SHORT)
    assert asked[-2:] == [(SHORT.final_spp, True), (SHORT.spp, False)]
    *_, last = made["measurements"]
    assert made["finished"] and (last["step"], last["spp"]) == (SHORT.steps, SHORT.spp)
    assert (tmp_path / "out" / "train_000-lhs.exr").is_file()


def test_what_was_learned_is_written_between_measurements(tmp_path, monkeypatch):
    step = SolverStep.__call__

    def killed(self, optimizer, number, *args):
        if number == 28:
            raise Killed
        return step(self, optimizer, number, *args)

    monkeypatch.setattr(SolverStep, "__call__", killed)
    monkeypatch.setattr(learn, "MEASURED", (0.0, 1.0))
    for seconds, kept in ((0.0, 24), (1e9, 0)):
        monkeypatch.setattr(learn, "_KEPT", seconds)
        out = tmp_path / f"out-{kept}"
        with pytest.raises(Killed):
            solve("furnace", out, SHORT)
        assert read_solved(out).steps == kept
        assert [entry["step"] for entry in read_object(out / "solve.json")["measurements"]] == [0]
    values = [load_file(tmp_path / name / "radiance.safetensors") for name in ("out-24", "out-0")]
    assert any((values[0][key] != values[1][key]).any() for key in values[0])


def test_a_disk_that_is_full_for_a_while_ends_no_training(tmp_path, monkeypatch, capsys):
    write, times = learn.write_solved, []

    def full(*args):
        times.append(1)
        if len(times) < 4:
            raise UserError("cannot be written (No space left on device)", tmp_path)
        write(*args)

    monkeypatch.setattr(learn, "write_solved", full)
    made = solve("furnace", tmp_path / "out", SHORT, console=Console())
    assert made["finished"] and read_solved(tmp_path / "out").steps == SHORT.steps
    assert capsys.readouterr().out.count("the training goes on, and it is tried again") == 3


def test_pixels_that_are_not_finite_end_no_training(tmp_path, monkeypatch, capsys):
    sides, halves = learn.both_sides, learn.path_traced_halves

    def broken_sides(*args, **more):
        found = sides(*args, **more)
        found["rhs"][0][3, 5] = np.nan
        return found

    def broken_halves(*args, **more):
        found = halves(*args, **more)
        found[1][0][2, :2, 1] = np.inf
        return found

    monkeypatch.setattr(learn, "both_sides", broken_sides)
    monkeypatch.setattr(learn, "path_traced_halves", broken_halves)
    lines = []
    settings = replace(SHORT, reference_spp=8)
    made = solve("furnace", tmp_path / "out", settings, console=Console(), tell=lines.append)
    assert any("2 pixels of the reference are not finite" in line for line in lines)
    assert "pixels (0 of LHS, 1 of RHS) are not finite" in capsys.readouterr().out
    told = read_object(tmp_path / "out" / "solve.json")
    assert told["reference_not_finite"] == 2 and told["finished"]
    assert told["measurements"][-1]["not_finite"] == {"lhs": 0, "rhs": 1}
    numbers = [told["reference_noise"], *told["measurements"][-1]["relmse"].values()]
    assert np.isfinite(numbers).all() and made["measurements"] == told["measurements"]
    assert (tmp_path / "out" / "train_000-rhs.png").is_file()


@pytest.mark.parametrize(("problem", "option"), [(None, "--resolution"), (object(), "--cameras")])
def test_pictures_that_do_not_fit_into_memory_are_refused_at_once(
    problem, option, tmp_path, monkeypatch
):
    camera = LookAt((0, 0, 3), (0, 0, 0), (0, 1, 0), 40).camera(640, 480)
    known = learn.Known(None, {"a": camera, "b": camera}, True, None, {}, problem)
    monkeypatch.setattr("unbake.memory.free_bytes", lambda: 100 * 2 * 640 * 480)
    with pytest.raises(UserError, match="pictures of 2 views need about") as caught:
        learn.learn(known, None, SolveSettings(), tmp_path / "out", None, print)
    assert option in caught.value.remedy and "--reference-spp 0" in caught.value.remedy
    assert not (tmp_path / "out").exists()
    learn._require_memory(known, SolveSettings(reference_spp=0))  # it needs less


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--attach-rhs", "--samples", "3"], "even number of samples"),
        (["--reference-spp", "5"], "even"),
        (["--steps", "0"], "--steps"),
        (["--keep-lights"], "--keep-lights: needs --envmap or --lights"),
        (["--cameras", "c.json", "--views", "2"], "--views: cannot be given together"),
        (["--batch", "4194304"], "too many"),
    ],
)
def test_options_that_make_no_sense_are_refused(unbake, tmp_path, words, said):
    done = unbake("solve", "furnace", "--out", tmp_path / "s", *words)
    assert done.status == 2 and said in done.err
    assert not (tmp_path / "s").exists()


# ---------------------------------------------------------------------- with runs of fits


@pytest.fixture(scope="module")
def run(cornell, tiny, tmp_path_factory):
    """A fit of a captured data set, of no steps: its fields are untrained."""
    folder = tmp_path_factory.mktemp("fitted") / "run"
    fit(cornell, folder, replace(read_toml(tiny), steps=0), console=Console(quiet=True))
    return folder


@pytest.fixture(scope="module")
def sky(tmp_path_factory):
    """A sky that no photograph showed, ten times as bright as the lights of the scene."""
    file = tmp_path_factory.mktemp("sky") / "sky.exr"
    write_exr(file, np.full((8, 16, 3), (30.0, 20.0, 10.0), np.float32))
    return file


@pytest.fixture(scope="module")
def tuned(run, sky, tmp_path_factory):
    """The field of the run, learned on under the sky; the folder and what was told."""
    out, lines = tmp_path_factory.mktemp("tuned") / "out", []
    settings = replace(SETTINGS, steps=100, reference_spp=128, final_spp=16)
    fine_tune(run, out, settings, light=LightConfig(envmap=sky), tell=lines.append)
    return out


def test_the_field_of_a_run_is_learned_on_under_another_light(tuned, run, cornell):
    told = read_object(tuned / "solve.json")
    first, *_, last = told["measurements"]
    assert last["step"] == 100 and last["skipped"] == 0
    assert told["views"] == ["heldout_000"] and told["kind"] == "room"
    assert told["run"] == {"folder": str(run.resolve()), "steps": 0}
    assert told["light"]["envmap"].endswith("sky.exr")
    for side in ("lhs", "rhs"):  # such a tiny network shows little more than the mean
        assert last["relmse"][side] < 0.5 * first["relmse"][side]
    seen = {side: read_exr(tuned / f"heldout_000-{side}.exr") for side in ("rhs", "reference")}
    photograph = read_exr(Dataset.load(cornell).heldout[0].image)[..., :3]
    assert seen["rhs"].mean() == pytest.approx(seen["reference"].mean(), rel=0.2)
    assert seen["reference"].mean() > 3 * photograph.mean()


def test_a_run_in_half_precision_is_learned_on_in_single(cornell, tiny, tmp_path):
    """Without a scale of the loss, small gradients would be rounding alone."""
    config = replace(read_toml(tiny), steps=2, precision="half")
    fit(cornell, tmp_path / "run", config, console=Console(quiet=True))
    started = load_run(tmp_path / "run").problem.learned_parameters()
    with pytest.MonkeyPatch.context() as patch:
        begun = []
        patch.setattr(solving, "learn", lambda *words: begun.append(words) or {})
        fine_tune(tmp_path / "run", tmp_path / "out", SETTINGS, tell=lambda line: None)
    known, start = begun[0][:2]
    assert load_run(tmp_path / "run").problem.half_precision
    assert not known.problem.half_precision and start.radiance is known.problem.radiance
    for key, value in start.radiance.parameters().items():
        np.testing.assert_array_equal(np.array(value), np.array(started[key]))
    made = fine_tune(tmp_path / "run", tmp_path / "tuned", SHORT, tell=lambda line: None)
    assert made["measurements"][-1]["skipped"] == 0
    assert read_solved(tmp_path / "tuned").steps == SHORT.steps


@pytest.mark.parametrize(("size", "told"), [(16, False), (12, True)])
def test_pictures_of_large_views_are_smaller(size, told, run, cornell, tmp_path, monkeypatch):
    begun, lines = [], []
    monkeypatch.setattr(solving, "learn", lambda known, *words: begun.append(known) or {})
    monkeypatch.setattr(solving, "LARGEST", size)
    fine_tune(run, tmp_path / "out", SETTINGS, tell=lines.append)
    (camera,) = begun[0].cameras.values()
    assert (camera.width, camera.height) == (size, size)
    (own,) = Dataset.load(cornell).heldout
    assert camera.fl_x / camera.width == pytest.approx(own.camera.fl_x / own.camera.width)
    assert any("--cameras FILE says other sizes" in line for line in lines) == told


def test_small_pictures_keep_their_shape():
    camera = LookAt((0, 0, 3), (0, 0, 0), (0, 1, 0), 40).camera(3000, 2000)
    small = solving._small(camera)
    assert (small.width, small.height) == (512, 341)
    assert solving._small(small) is small


def test_a_sky_that_lies_on_its_side_is_told(run, sky, tmp_path, monkeypatch):
    monkeypatch.setattr(solving, "learn", lambda *words: {})
    lines = []
    for axis in ("+y", "+z"):
        light = LightConfig(envmap=sky, envmap_up=axis)
        fine_tune(run, tmp_path / axis, SETTINGS, light=light, tell=lines.append)
    (line,) = [line for line in lines if "the map's first row" in line]
    assert "lies at +y, while the cameras' up is +z: --envmap-up +z turns it" in line


def test_a_field_is_brightened_until_both_sides_have_the_same_mean(solved, built_in):
    scene = mi.load_file(str(built_in("furnace")))
    points, radiance = SurfacePoints.of(scene), load_radiance(solved)
    radiance.scale /= 8
    factor = matching_scale(SceneView.of(scene, None, 8), radiance, points, 0)
    assert factor == pytest.approx(8, rel=0.03)


def test_a_field_is_brightened_by_any_factor(solved, built_in):
    scene = mi.load_file(str(built_in("furnace")))
    points, radiance = SurfacePoints.of(scene), load_radiance(solved)
    scale = radiance.scale
    for factor in (1e-9, 1e9):
        radiance.scale = scale / factor
        found = matching_scale(SceneView.of(scene, None, 8), radiance, points, 0)
        assert found == pytest.approx(factor, rel=0.03)


def test_a_fit_starts_with_a_solved_field(tuned, unbake, cornell, tiny, tmp_path):
    words = ("fit", cornell, "--out", tmp_path / "warm")
    done = unbake(*words, "--settings", tiny, "--steps", 0, "--radiance-from", tuned)
    assert done.status == 0, done.err
    assert "L starts as solved in 100 steps" in done.out
    wanted, started = load_radiance(tuned), load_run(tmp_path / "warm").problem.radiance
    origin = RunFolder(tmp_path / "warm").origin()
    assert started.scale == wanted.scale == origin.warm_start.scale != origin.mean_radiance
    assert origin.warm_start.folder == str(tuned.resolve()) and origin.warm_start.steps == 100
    for key, value in wanted.parameters().items():
        np.testing.assert_array_equal(np.array(value), np.array(started.parameters()[key]))
    refused = unbake(*words, "--resume", "--steps", 2, "--radiance-from", tuned)
    assert refused.status == 2 and "--resume" in refused.err


def test_a_fit_without_a_checkpoint_begins_again_with_the_solved_field(
    tuned, unbake, cornell, tiny, tmp_path
):
    copy = shutil.copytree(tuned, tmp_path / "solved")
    words = ("fit", cornell, "--out", tmp_path / "warm")
    done = unbake(*words, "--settings", tiny, "--steps", 1, "--radiance-from", copy)
    assert done.status == 0, done.err
    shutil.rmtree(tmp_path / "warm" / "checkpoints")  # as if it was killed before the first one
    started = []

    def seen(problem, solved):
        started.append(solved.sha256)
        return start_radiance(problem, solved)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(beginning, "start_radiance", seen)
        done = unbake(*words, "--resume", "--steps", 2)
    assert done.status == 0 and "it begins again" in done.out
    assert started == [RunFolder(tmp_path / "warm").origin().warm_start.sha256]
    shutil.rmtree(tmp_path / "warm" / "checkpoints")
    values = load_file(copy / "radiance.safetensors")
    save_file({key: x + 1 for key, x in values.items()}, copy / "radiance.safetensors")
    done = unbake(*words, "--resume", "--steps", 2)
    assert done.status == 2 and "not the solved field any more" in done.err


@pytest.mark.slow
def test_a_fit_that_started_with_a_solved_field_goes_on(tuned, unbake, cornell, tiny, tmp_path):
    words = ("fit", cornell, "--out", tmp_path / "warm")
    start = ("--settings", tiny, "--steps", 1, "--radiance-from", tuned)
    assert unbake(*words, *start).status == 0
    begun = RunFolder(tmp_path / "warm").origin().warm_start
    assert unbake(*words, "--resume", "--steps", 2).status == 0
    resumed = load_run(tmp_path / "warm")
    assert resumed.progress.step == 2 and resumed.problem.radiance.scale == begun.scale
    assert RunFolder(tmp_path / "warm").origin().warm_start == begun


def test_a_field_of_another_scene_starts_no_fit(solved, unbake, cornell, tmp_path):
    done = unbake("fit", cornell, "--out", tmp_path / "run", "--radiance-from", solved)
    assert done.status == 2 and "another scene (furnace)" in done.err, done.err
    assert "Solve the scene of the data set" in done.err
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"method": "prb"}, "prb has no radiance field"),
        ({"radiance_representation": "grid"}, "--radiance neural"),
        ({"radiance": {"neural": replace(SMALL, width=24)}}, "width is 16 there and 24 here"),
        ({"radiance": {"neural": NetworkConfig(GridConfig(levels=3))}}, "levels is 2 there and 3"),
    ],
)
def test_a_solved_field_of_another_size_or_kind_is_refused(solved, changes, said):
    with pytest.raises(UserError) as refused:
        with_solved_field(replace(FitConfig(), **changes), read_solved(solved))
    assert said in str(refused.value)


def test_settings_that_are_left_open_are_those_of_the_solved_field(solved):
    own = NetworkConfig(GridConfig(footprints=2.0), learning_rate=0.003)
    config = with_solved_field(FitConfig(radiance={"neural": own}), read_solved(solved))
    assert config.radiance_settings == replace(SMALL, learning_rate=0.003)


def test_scenes_are_told_apart_by_rays_through_them(built_in, cornell):
    grey, white = (mi.load_file(str(built_in("furnace", albedo))) for albedo in (0.5, 0.8))
    other = mi.load_file(str(Dataset.load(cornell).scene))
    assert differing(probe(grey), probe(white)) == 0
    assert differing(probe(grey), probe(other)) > 0.3  # the same box, and two more in it


def test_a_run_without_a_field_and_words_that_exclude_each_other_are_refused(
    unbake, cornell, tiny, tmp_path
):
    words = ("fit", cornell, "--out", tmp_path / "run", "--settings", tiny, "--method", "direct")
    assert unbake(*words, "--steps", 0).status == 0
    for words, said in (
        (["--from", tmp_path / "run"], "no radiance field"),
        (["--from", tmp_path / "none"], "no run in this folder"),
        (["--from", tmp_path / "run", "--views", 3], "--views"),
        (["furnace", "--from", tmp_path / "run"], "not both"),
        ([], "give a scene"),
    ):
        done = unbake("solve", *words, "--out", tmp_path / "s")
        assert done.status == 2 and said in done.err, done.err
        assert not (tmp_path / "s").exists()
