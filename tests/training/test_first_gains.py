"""Points that photographs share: of pixels that count alone, and of no others."""

from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from support import on_ranks, tiny_fields

from unbake.dataset.camera import Camera
from unbake.dataset.views import Dataset
from unbake.scene.parse import parse
from unbake.training import first_gains as module
from unbake.training.cameras import radius2
from unbake.training.first_gains import first_gains, shared_points
from unbake.training.problem import pixels_of

#: Radiance of what nobody is to look at.
GLARE = 123.0


@pytest.fixture
def masked(cornell, tmp_path):
    """Two views, of which the second one shows glare in its left half, which is masked."""
    dataset, mask, image = Dataset.load(cornell), tmp_path / "mask.png", tmp_path / "glare.exr"
    codes = np.zeros((16, 16, 1), np.uint8)
    codes[:, 8:] = 255
    mi.Bitmap(codes).write(str(mask))
    views = list(dataset.views)
    last = max(i for i, view in enumerate(views) if view.split == "train")
    pixels = np.array(mi.Bitmap(str(views[last].image)).convert(mi.Bitmap.PixelFormat.RGBA))
    pixels[:, :8, :3] = GLARE
    mi.Bitmap(pixels).write(str(image))
    views[last] = replace(views[last], mask=mask, image=image)
    return replace(dataset, views=tuple(views), allow_outside=True)


def test_masked_pixels_are_no_partners(masked):
    scene = parse(masked.scene, masked.root).instantiate()

    def shared(ranks):
        pixels = pixels_of(masked, tiny_fields(), clip_negative=False, ranks=ranks)
        return shared_points(scene, masked.train, pixels)

    (alone,) = on_ranks(1, shared)
    assert len(alone.point) > 40
    assert not np.isclose(alone.logs, np.log(GLARE)).any()
    assert np.abs(np.log2(first_gains(alone)[1])).max() < 0.3
    for found in on_ranks(2, shared):
        np.testing.assert_array_equal(found.logs, alone.logs)


def test_distances_from_the_middle_are_those_of_shared_points_alone(cornell, monkeypatch):
    """Those of all pixels of all photographs take more memory than these."""
    asked = []

    def noted(camera, numbers=None):
        asked.append(numbers)
        return radius2(camera, numbers)

    monkeypatch.setattr(module, "radius2", noted)
    dataset = Dataset.load(cornell)
    pixels = pixels_of(dataset, tiny_fields(), clip_negative=False)
    scene = parse(dataset.scene, dataset.root).instantiate()
    shared = shared_points(scene, dataset.train, pixels)
    assert asked and all(numbers is not None for numbers in asked)
    assert sum(map(len, asked)) == shared.radius2.size


def test_distances_from_the_middle_are_those_of_each_view():
    sizes = [(5, 3), (4, 4), (7, 2)]
    cameras = [Camera(np.eye(4), 9, 9, w / 2 + 0.3, h / 2, w, h) for w, h in sizes]
    firsts = np.cumsum([0, *(w * h for w, h in sizes)])
    every = np.concatenate([radius2(camera) for camera in cameras])
    numbers = np.random.default_rng(0).permutation(len(every)).astype(np.uint32)
    numbers = numbers[(numbers < 15) | (numbers >= 31)]  # of the middle view, none is asked for
    of = np.searchsorted(firsts, numbers, "right") - 1
    views = [SimpleNamespace(camera=camera) for camera in cameras]
    found = module._radius2(views, firsts, numbers, of)
    np.testing.assert_array_equal(found, every[numbers])
