"""What training views tell of an environment: what lights the surfaces that they show."""

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

from unbake.dataset.camera import Camera
from unbake.fields.envmap import latlong
from unbake.training.surroundings import surroundings


def told(shapes, *cameras, hidden=False):
    """Of a scene of these shapes, by these cameras."""
    scene = mi.load_dict({"type": "scene", **shapes})
    view = SimpleNamespace(scene=scene)
    problem = SimpleNamespace(scene_view=view, hide_emitters=hidden)
    dataset = SimpleNamespace(train=(), background="visible")
    run = SimpleNamespace(problem=problem, cameras=list(cameras), dataset=dataset)
    return surroundings(run, 32)


def wall(to, up=None, **more):
    place = mi.ScalarTransform4f().look_at([0, 0, 0], [-x for x in to], up or [0, 1, 0])
    return {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate(to) @ place, **more}


#: A room from -1 to 1 that is open towards +z, but for what is put there.
ROOM = {
    "floor": wall([0, -1, 0], [0, 0, 1]),
    "ceiling": wall([0, 1, 0], [0, 0, 1]),
    "left": wall([-1, 0, 0]),
    "right": wall([1, 0, 0]),
    "back": wall([0, 0, -1]),
}
INSIDE = Camera.look_at((0, 0, 0.9), (0, 0, -1), (0, 1, 0), 90.0, 16, 16)
BEFORE = np.moveaxis(
    latlong(lambda d: mi.Color3f(d.z), 32, 1), 2, 0
)[0]  # z of directions  # fmt: skip


def test_a_room_knows_the_sky_before_its_window():
    found = told(ROOM, INSIDE)
    assert found.lit[BEFORE > 0.8].all() and not found.lit[BEFORE < 0].any()
    assert 0.2 < found.share < 0.5
    assert found.note == f"nothing is known of {100 * (1 - found.share):.0f} % of the environment"


def test_a_pane_hides_nothing_and_a_wall_all():
    pane = wall([0, 0, 1], bsdf={"type": "thindielectric"})
    alone = told(ROOM, INSIDE).share
    assert told(ROOM | {"pane": pane}, INSIDE).share == pytest.approx(alone, abs=0.02)
    closed = told(ROOM | {"front": wall([0, 0, 1])}, INSIDE)
    assert closed.share == 0 and "100 % of the environment" in closed.note


@pytest.mark.parametrize("hidden", [False, True])
def test_what_photographs_show_of_it_is_known(hidden):
    """A floor in the open: what is above it lights it, and cameras show what is below."""
    floor = {"floor": wall([0, -1, 0], [0, 0, 1])}
    below = Camera.look_at((0, -1.2, 0), (0, -5, 0), (0, 0, 1), 120.0, 16, 16)
    above = Camera.look_at((0, 0, 0.2), (0, -1, 0), (0, 0, 1), 60.0, 16, 16)
    lit = told(floor, above, hidden=hidden)
    assert lit.share == pytest.approx(0.5, abs=0.06)
    assert told(floor, below, hidden=hidden).share == (
        0 if hidden else pytest.approx((1 - np.cos(np.radians(65))) / 2, abs=0.08)
    )


def test_what_is_seen_through_a_pane_or_a_hole_is_known():
    below = Camera.look_at((0, -1.2, 0), (0, -5, 0), (0, 0, 1), 120.0, 16, 16)
    hole = {"type": "mask", "opacity": 0.0, "nested": {"type": "diffuse"}}
    floor = {"floor": wall([0, -1, 0], [0, 0, 1])}
    open_ = told(floor, below)
    for bsdf in ({"type": "thindielectric"}, hole, {"type": "null"}):
        pane = wall([0, -1.4, 0], [0, 0, 1], bsdf=bsdf)
        assert told(floor | {"pane": pane}, below).share == pytest.approx(open_.share, abs=0.02)


def test_all_is_known_around_a_ball():
    front, back = (Camera.look_at((0, 0, z), (0, 0, 0), (0, 1, 0), 60.0, 16, 16) for z in (5, -5))
    ball = {"ball": {"type": "sphere"}}
    assert 0.6 < told(ball, front, hidden=True).share < 0.95
    around = told(ball, front, back, hidden=True)
    assert around.share > 0.95 and around.note is None
