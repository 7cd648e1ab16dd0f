"""Poses that do not belong to the scene are told with what is wrong; good ones never are."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support import built_in_cameras

from unbake.dataset import poses
from unbake.dataset.photographs import Photographs
from unbake.dataset.poses import pose_warnings
from unbake.dataset.views import View
from unbake.errors import UserError
from unbake.scene.parse import parse

SIZE, VIEWS = 24, 4
SCENES = ("demo", "cornell", "cube", "still", "annex", "furnace")


@pytest.fixture(scope="module")
def seen(built_in):
    """A built-in scene, its cameras, and photographs of what they see."""

    def make(name):
        scene = parse(built_in(name)).instantiate()
        cameras = built_in_cameras(name, SIZE, VIEWS)
        count = SIZE * SIZE * len(cameras)
        alpha = poses._seen(scene, cameras, np.arange(count))
        hidden = not alpha.all()
        found = Photographs.of(cameras, np.ones((count, 3)), alpha, foreground_only=hidden)
        return scene, cameras, found

    return make


def warnings(scene, cameras, photographs, hidden=None):
    hidden = photographs.chosen is not None if hidden is None else hidden
    views = [
        View(f"train_{i:03d}", "train", c, Path("none.exr"), {}) for i, c in enumerate(cameras)
    ]
    return pose_warnings(scene, views, photographs, "data", hidden=hidden)


@pytest.mark.parametrize("name", SCENES)
def test_good_poses_are_not_doubted(name, seen):
    assert warnings(*seen(name)) == []


def test_masks_do_not_hide_the_sky(seen):
    """Where the background is visible, pixels that count may see it, masks or none."""
    scene, cameras, _ = seen("still")
    count = SIZE * SIZE * len(cameras)
    counted = np.arange(count) % 7 > 0
    found = Photographs.of(cameras, np.ones((count, 3)), counted, foreground_only=True)
    assert scene.environment() is not None
    assert warnings(scene, cameras, found, hidden=False) == []
    assert "of the pixels to train on see a surface" in warnings(scene, cameras, found)[0]


def test_no_pixel_that_counts_says_nothing_of_poses(seen):
    scene, cameras, _ = seen("still")
    count = SIZE * SIZE * len(cameras)
    found = Photographs.of(cameras, np.ones((count, 3)), np.zeros(count), foreground_only=True)
    assert found.count == 0 and warnings(scene, cameras, found) == []


def moved(scale=1.0, turn=None, flip=None):
    """Cameras as a mistaken file has them."""

    def change(camera):
        pose = camera.to_world.copy()
        pose[:3, :3] = (np.eye(3) if turn is None else turn) @ pose[:3, :3]
        pose[:3, 3] = scale * ((np.eye(3) if turn is None else turn) @ pose[:3, 3])
        if flip is not None:
            pose[:3, :3] = pose[:3, :3] @ flip
        return replace(camera, to_world=pose)

    return change


OPENCV = np.diag([1.0, -1.0, -1.0])
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
MISTAKES = {
    "millimetres": (
        moved(1000.0),
        "in other units (multiply positions by 0.001; or the mesh: import --mesh-scale 1000)",
    ),
    "kilometres": (moved(0.001), "in other units (multiply positions by 1000; or the mesh"),
    "OpenCV": (moved(flip=OPENCV), "in OpenCV's axes (negate columns 2 and 3 of the matrix)"),
    "both": (
        moved(1000.0, flip=OPENCV),
        "in OpenCV's axes (negate columns 2 and 3 of the matrix) and in other units (multiply",
    ),
}


@pytest.mark.parametrize(
    ("name", "mistake"),
    [
        ("still", "millimetres"),
        ("still", "OpenCV"),
        ("still", "both"),
        ("cornell", "millimetres"),
        ("cornell", "OpenCV"),
        ("demo", "millimetres"),
    ],
)
def test_poses_that_see_nothing_are_refused_with_the_likely_mistake(name, mistake, seen):
    scene, cameras, photographs = seen(name)
    change, told = MISTAKES[mistake]
    try:
        (line,) = warnings(scene, [change(c) for c in cameras], photographs)
        assert line.startswith("only ") or ": the view sees no surface of the scene. " in line
    except UserError as error:
        line = str(error)
        assert "data: no training view sees a surface of the scene. Are poses" in line
    assert told in line
    share = float(line.split("Without that ")[1].split(" %")[0])
    assert share > 90


def test_a_world_with_another_axis_up_is_named(seen):
    scene, cameras, photographs = seen("still")
    (line,) = warnings(scene, [moved(turn=Z_UP)(c) for c in cameras], photographs)
    assert "of a world with z up (turn them by -90° about x: y, z become z, -y; or the mesh" in line
    (line,) = warnings(scene, [moved(turn=Z_UP.T)(c) for c in cameras], photographs)
    told = "y up (turn them by 90° about x: y, z become -z, y; or the mesh: import without --mesh-y"
    assert told in line


def test_poses_of_another_scene_are_told_without_a_guess(seen):
    scene, cameras, photographs = seen("still")
    cameras = [moved()(replace(c, to_world=_away(c.to_world))) for c in cameras]
    with pytest.raises(UserError, match="Check the axes and the units of the poses"):
        warnings(scene, cameras, photographs)


def _away(pose):
    """Far off, and looking along x."""
    away = np.eye(4)
    away[:3, :3] = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]
    away[:3, 3] = pose[:3, 3] + [1e7, 2e7, 3e7]
    return away


def test_a_view_that_sees_nothing_is_named(seen):
    scene, cameras, photographs = seen("still")
    cameras[2] = moved(flip=OPENCV)(cameras[2])
    (line,) = warnings(scene, cameras, photographs)
    assert line.startswith("only 7") or line.startswith(
        "train_002: the view sees no surface of the scene. Check the axes"
    )
