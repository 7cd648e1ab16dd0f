"""Fits whose processes each learn from views of their own: the same objective, the same numbers."""

import subprocess
import sys
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import MPIEXEC, needs_mpi, on_ranks, tiny_fields

from unbake.config import CameraConfig, ObjectiveConfig, RegularizationConfig, to_toml
from unbake.dataset.views import Dataset
from unbake.ranks import Ranks
from unbake.scene.parse import parse
from unbake.training.first_gains import first_gains, shared_points
from unbake.training.problem import pixels_of, problem_of
from unbake.training.run_folder import RunFolder
from unbake.training.sharing import kept_whole
from unbake.training.state import initial_state
from unbake.training.step import TrainingStep


class Noting(Ranks):
    """A rank of two in this process, which notes what it would tell the other one."""

    def __init__(self, rank):
        super().__init__()
        self.rank, self.size, self.noted = rank, 2, []

    def mean(self, numbers):
        self.noted.append(numbers.copy())
        return np.zeros_like(numbers)


@pytest.fixture
def uneven(cornell, tmp_path):
    """Two views, of which the second one has three quarters masked, and its other pixels bright."""
    dataset = Dataset.load(cornell)
    mask, image = tmp_path / "mask.png", tmp_path / "bright.exr"
    codes = np.zeros((16, 16, 1), np.uint8)
    codes[:8, :8] = 255
    mi.Bitmap(codes).write(str(mask))
    views = list(dataset.views)
    last = max(i for i, view in enumerate(views) if view.split == "train")
    pixels = np.array(mi.Bitmap(str(views[last].image)).convert(mi.Bitmap.PixelFormat.RGBA))
    pixels[..., :3] *= 3
    mi.Bitmap(pixels).write(str(image))
    views[last] = replace(views[last], mask=mask, image=image)
    return replace(dataset, views=tuple(views), allow_outside=True)


def test_the_mean_over_processes_is_the_gradient_of_all_pixels(uneven):
    config = replace(tiny_fields(), pixels=64, method="direct", loss_epsilon=0.1)
    config = replace(config, regularization=RegularizationConfig(albedo_smoothness=0.0))
    whole = pixels_of(uneven, config, clip_negative=False)
    parts = on_ranks(2, lambda ranks: pixels_of(uneven, config, clip_negative=False, ranks=ranks))
    assert [part.weight(crops=False) for part in parts] == [1.6, 0.4]
    assert {part.photographs.level for part in parts} == {whole.photographs.level}
    found = []
    for rank, pixels in ((0, whole), (0, parts[0]), (1, parts[1])):
        problem, ranks = problem_of(uneven, config, 0.2), Noting(rank)
        step, state = TrainingStep(problem, pixels, config, ranks), initial_state(problem)
        rates = dict.fromkeys(step.rate_names, 0.0)
        for number in range(400):
            step(state, number, rates)
        dr.sync_thread()
        found.append(np.array(ranks.noted, np.float64))
    one, two = found[0], (found[1] + found[2]) / 2
    told = (one.std(0) > 0) & (two.std(0) > 0)
    assert told.sum() > 100
    noise = np.sqrt((one.var(0) + two.var(0)) / len(one))
    z = ((one.mean(0) - two.mean(0)) / np.where(told, noise, 1))[told]
    assert abs(z[0]) < 4 and np.sqrt(np.mean(z**2)) < 1.5


def test_first_gains_are_those_of_all_photographs(cornell):
    dataset = Dataset.load(cornell)
    scene = parse(dataset.scene, dataset.root).instantiate()

    def gains(ranks):
        pixels = pixels_of(dataset, tiny_fields(), clip_negative=False, ranks=ranks)
        assert len(pixels.photographs.table) == 512 // ranks.size
        return first_gains(shared_points(scene, dataset.train, pixels))

    (alone,) = on_ranks(1, gains)
    for found in on_ranks(2, gains):
        np.testing.assert_array_equal(found, alone)


@pytest.mark.parametrize(
    ("ranks", "change", "told"),
    [
        (2, {}, None),
        (2, {"camera": CameraConfig(exposure="per-image", poses="refined")}, None),
        (2, {"pixel_sampling": "one-view-crop"}, None),
        (3, {}, "there are 2 training views for 3 processes"),
        (2, {"sync_every": 2}, "--sync-every"),
        (2, {"objective": ObjectiveConfig(outliers="found")}, "--outliers"),
        (2, {"regularization": RegularizationConfig(albedo_ties_roughness=1.0)}, "are paired"),
    ],
)
def test_what_is_not_a_mean_over_pixels_takes_all_photographs(cornell, ranks, change, told):
    several = Ranks()
    several.size = ranks
    config = replace(tiny_fields(), **change)
    found = kept_whole(config, Dataset.load(cornell), several)
    assert found is None if told is None else told in found


def test_an_anchored_mean_albedo_takes_all_photographs(cornell):
    several, dataset = Ranks(), Dataset.load(cornell)
    several.size = 2
    config = replace(tiny_fields(), unknown="materials+lighting")
    assert kept_whole(config, dataset, several) is None
    hidden = replace(dataset, background="hidden")
    assert "mean albedo" in kept_whole(config, hidden, several)


@needs_mpi
@pytest.mark.parametrize(
    ("ranks", "options", "said"),
    [
        (2, ["--exposures", "per-image"], None),
        (3, [], "each process reads all photographs: there are 2 training views for 3 processes"),
    ],
)
def test_a_run_does_not_tell_how_its_photographs_were_dealt(
    cornell, tmp_path, unbake, ranks, options, said
):
    settings, out = tmp_path / "settings.toml", tmp_path / "run"
    small = replace(tiny_fields(), method="direct", pixels=48, held_aside=0.25, steps=4)
    settings.write_text(to_toml(small))
    words = [MPIEXEC, "-n", str(ranks), sys.executable, "-m", "unbake", "fit", cornell, "--out"]
    words += [out, "--settings", settings, *options]
    done = subprocess.run(map(str, words), capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    assert said in done.stdout if said else "each process reads all" not in done.stdout
    more = unbake("fit", cornell, "--out", out, "--resume", "--steps", 6)
    assert more.status == 0, more.err
    assert [line["step"] for line in RunFolder(out).log() if "photometric" in line][-1] == 6
