"""Camera placement: in the open, looking at everything, and reproducible."""

import math

import mitsuba as mi
import numpy as np
import pytest

from unbake.acquisition.coverage import black_share, coverage, is_room, view_counts
from unbake.acquisition.placement import place, place_object, place_room
from unbake.dataset.camera import Camera
from unbake.dataset.poses import check_cameras
from unbake.errors import UserError
from unbake.scene import free_space

MATTE = {"type": "twosided", "bsdf": {"type": "principled", "roughness": 0.9}}
SIDES = [([0, 1, 0], angle) for angle in (0, 90, 180, 270)]
SIDES += [([1, 0, 0], angle) for angle in (90, 270)]


def walls(flipped=False, scale=(1, 1, 1)):
    """The six sides of the box [-1, 1]^3 times `scale`, normals inwards unless flipped."""
    shapes = {}
    for index, (axis, angle) in enumerate(SIDES):
        to_world = mi.ScalarTransform4f().scale(list(scale)).rotate(axis, angle)
        shape = {"type": "rectangle", "to_world": to_world.translate([0, 0, -1]), "bsdf": MATTE}
        shapes[f"wall{index}"] = shape | {"flip_normals": flipped}
    return shapes


def box(centre, scale):
    to_world = mi.ScalarTransform4f().translate(list(centre)).scale(scale)
    return {"type": "cube", "to_world": to_world, "bsdf": MATTE}


def on_emitter(centre):
    light = {"type": "area", "radiance": {"type": "rgb", "value": 5.0}}
    to_world = mi.ScalarTransform4f().translate(list(centre)).scale(0.1)
    return {"type": "sphere", "to_world": to_world, "light": light}


def sensor(origin, target, up=(0, 1, 0)):
    return Camera.look_at(origin, target, up, 60.0, 8, 8).sensor(1)


def scene(**shapes):
    # Mitsuba cannot merge rectangles with cubes
    return mi.load_dict({"type": "scene", **shapes}, optimize=False)


@pytest.fixture(scope="module")
def room():
    """A lit room with a cupboard (hollow, closed) in a corner, and a ball far outside."""
    return scene(
        **walls(),
        cupboard=box((0.5, -0.5, 0.5), 0.49),
        on_emitter=on_emitter((-0.3, 0.85, -0.3)),
        outside={"type": "sphere", "center": [2.5, 0, 0], "radius": 0.2, "bsdf": MATTE},
        sensor=sensor((-0.6, 0, -0.6), (0, 0, 0)),
    )


@pytest.fixture(scope="module")
def placed(room):
    return place_room(room, 10, 4, fov=80.0)


@pytest.fixture(scope="module")
def ball():
    """A ball at (1, 2, 3) of radius 2 above a large floor, lit by the sky."""
    floor = mi.ScalarTransform4f().translate([0, -0.5, 0]).rotate([1, 0, 0], -90).scale(40)
    return scene(
        ball={"type": "sphere", "center": [1, 2, 3], "radius": 2, "bsdf": MATTE},
        floor={"type": "rectangle", "to_world": floor, "bsdf": MATTE},
        sky={"type": "constant"},
        sensor=sensor((1, 6, 12), (1, 2, 3)),
    )


def test_a_room_has_cameras_of_both_splits(placed):
    assert [split for split, _ in placed] == ["train"] * 10 + ["heldout"] * 4
    poses = np.array([look_at.camera(8, 8).to_world for _, look_at in placed])
    for one in range(len(poses)):
        for other in range(one):
            assert np.abs(poses[one] - poses[other]).max() > 0.05
    assert all(look_at.fov == 80.0 and look_at.up == (0, 1, 0) for _, look_at in placed)


def test_cameras_stand_in_the_free_space_of_the_room(room, placed):
    eyes = np.array([look_at.origin for _, look_at in placed])
    assert np.abs(eyes).max() < 1.0
    in_cupboard = (np.abs(eyes - [0.5, -0.5, 0.5]) < 0.49).all(axis=1)
    assert not in_cupboard.any()
    assert not check_cameras(room, {str(i): c.camera(8, 8) for i, (_, c) in enumerate(placed)})
    hits = [
        free_space.trace(room, np.tile(e, (200, 1)), free_space.sphere_directions(200))
        for e in eyes
    ]
    assert min(h.distance.min() for h in hits) > 0.09


def test_cameras_look_at_surfaces_from_a_distance(room, placed):
    for _, look_at in placed:
        way = np.subtract(look_at.target, look_at.origin)
        assert np.linalg.norm(way) > 0.4


def test_the_training_views_cover_the_room_and_held_out_views_look_at_the_same(room, placed):
    train = [c.camera(8, 8) for split, c in placed if split == "train"]
    held_out = [c.camera(8, 8) for split, c in placed if split == "heldout"]
    whole = coverage(room, train, 4000)
    assert 0.97 < whole <= 1.0
    # What only the held-out views see is hardly anything
    assert coverage(room, train + held_out, 4000) - whole < 0.01
    assert coverage(room, held_out, 4000) > 0.5
    assert coverage(room, train[:2], 4000) < whole


def test_a_seed_means_the_same_cameras_on_another_day(room, placed):
    assert place_room(room, 10, 4, fov=80.0) == placed
    assert place_room(room, 10, 4, fov=80.0, seed=1) != placed


def test_rooms_are_told_from_objects(room, ball):
    assert is_room(room)
    assert is_room(scene(**walls()))
    assert is_room(scene(**walls(flipped=True), sensor=sensor((0.5, 0, 0), (0, 0, 0))))
    assert not is_room(ball)
    assert not is_room(scene(ball={"type": "sphere"}))
    assert not is_room(scene(box=box((0, 0, 0), 1.0), sensor=sensor((0, 3, 5), (0, 0, 0))))


SKY = {"type": "constant"}
GLOW = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}


@pytest.mark.parametrize("bsdf", [MATTE, MATTE["bsdf"]], ids=["two-sided", "one-sided"])
def test_a_closed_box_is_a_room_only_if_there_is_light_in_it(bsdf):
    """Nothing but the light tells a cube that is an object from one that is a room."""
    thing = box((0, 0, 0), 1.0) | {"bsdf": bsdf}
    inward = thing | {"flip_normals": True}
    assert not is_room(scene(thing=thing, sky=SKY))
    assert not is_room(scene(thing=inward, sky=SKY))
    assert is_room(scene(thing=inward, lamp=on_emitter((0.2, 0.3, 0))))
    assert is_room(scene(furnace=inward | {"light": GLOW}))


def test_black_backs_of_materials_to_fit_tell_the_inside_of_an_object():
    """Principled BSDFs say that they have a back, which is black all the same."""
    for bsdf, inside in ((MATTE, False), (MATTE["bsdf"], True), ({"type": "diffuse"}, True)):
        thing = scene(thing=box((0, 0, 0), 1.0) | {"bsdf": bsdf})
        assert free_space.inside_geometry(thing, np.zeros((1, 3))).tolist() == [inside]


@pytest.mark.parametrize("ground", [False, True])
def test_a_lamp_around_everything_is_a_sky(ground):
    dome = {"type": "sphere", "radius": 50.0, "flip_normals": True, "light": GLOW}
    shapes = {"thing": box((0, 0, 0), 1.0), "dome": dome}
    shapes |= {"ground": lawn(-1, 30)} if ground else {}
    assert not is_room(scene(**shapes, sensor=sensor((0, 2, 6), (0, 0, 0))))
    camera = Camera.look_at((0, 2, 6), (0, 0, 0), (0, 1, 0), 60.0, 8, 8)
    assert not is_room(scene(**shapes), [camera])


def test_a_box_without_its_front_is_a_room_seen_from_outside():
    shapes = walls()
    del shapes["wall2"]
    cornell = scene(**shapes, sensor=sensor((0, 0, 4), (0, 0, 0)))
    assert is_room(cornell)
    assert all(np.abs(c.origin).max() < 1 for _, c in place_room(cornell, 4, 0))


def test_a_near_plane_beyond_a_room_does_not_make_it_an_object():
    """In large units Mitsuba's usual one is; one that cuts a wall away is where the view begins."""
    look = mi.ScalarTransform4f().look_at([0.2, 0, 0.5], [0, 0, 0], [0, 1, 0])
    far = {"type": "perspective", "near_clip": 50.0, "far_clip": 100.0, "to_world": look}
    closed = scene(**walls(), lamp=on_emitter((0.2, 0.3, 0)), sensor=far)
    assert is_room(closed)
    np.testing.assert_allclose(free_space.sensor_eyes(closed), [[0.2, 0, 0.5]], atol=1e-6)
    back = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    cut = {"type": "perspective", "near_clip": 3.5, "far_clip": 100.0, "to_world": back}
    np.testing.assert_allclose(
        free_space.sensor_eyes(scene(**walls(), sensor=cut)), [[0, 0, 0.5]], atol=1e-5
    )


@pytest.mark.parametrize("up", [(0, 1, 0), (0, 0, 1), (0, -1, 0), (1, 0, 0)])
def test_up_is_the_axis_that_the_sensor_stands_on(up):
    side = np.roll(up, 1).astype(float)
    eye = 0.5 * side + 0.3 * np.array(up)
    tilted = scene(**walls(), sensor=sensor(eye, (0, 0, 0), up))
    assert free_space.up_axis(tilted).tolist() == list(up)
    assert all(look_at.up == up for _, look_at in place_object(tilted, 2, 1))


def test_up_is_y_without_a_sensor():
    assert free_space.up_axis(scene(ball={"type": "sphere"})).tolist() == [0, 1, 0]


@pytest.mark.parametrize("up", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0, 1, 0)])
def test_cameras_have_the_axis_up_that_is_asked_for(up, room, ball):
    """Whatever the scene's own sensor says."""
    tilted = scene(ball={"type": "sphere", "bsdf": MATTE}, sensor=sensor((0, 0, 4), (0, 0, 0)))
    given = np.array(up, float)
    for of in (tilted, ball):
        placed = [look for _, look in place(of, 6, 1, up=given)]
        assert all(look.up == up for look in placed)
        assert all((np.array(look.origin) - look.target) @ given > 0 for look in placed)
    assert all(look.up == up for _, look in place(room, 3, 1, up=given))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_ground_that_speaks_for_another_axis_is_found(axis):
    """Where no sensor tells which way is up."""
    ball = {"type": "sphere", "center": np.eye(3)[axis].tolist(), "bsdf": MATTE}
    normal = np.eye(3)[axis].tolist()
    lies = mi.ScalarTransform4f().look_at([0, 0, 0], normal, np.roll(normal, 1).tolist())
    ground = {"type": "rectangle", "to_world": lies.scale(5), "bsdf": MATTE}
    found = free_space.up_of_ground(scene(ball=ball, ground=ground))
    assert found == (None if axis == 1 else f"+{'xyz'[axis]}")
    under = {**ball, "center": (-np.eye(3)[axis]).tolist()}
    assert free_space.up_of_ground(scene(ball=under, ground=ground)) == f"-{'xyz'[axis]}"
    look = sensor((4, 4, 4), (0, 0, 0))
    assert free_space.up_of_ground(scene(ball=ball, ground=ground, sensor=look)) is None
    assert free_space.up_of_ground(scene(ball=ball)) is None


def square(half, z=0):
    """A square whose normal is the z axis."""
    to_world = mi.ScalarTransform4f().translate([0, 0, z]).scale(half)
    return {"type": "rectangle", "to_world": to_world, "bsdf": MATTE}


@pytest.mark.parametrize(
    ("origin", "up"),
    [
        ((0, -1, 2), (0, 0, 1)),
        ((1, 0, 3), (0, 0, 1)),
        ((0, 0, 5), (0, 1, 0)),
        ((0, 0, 5), (1, 2, 0)),
    ],
    ids=["steep", "steeper", "straight", "straight and turned"],
)
def test_a_camera_that_looks_down_on_a_ground_has_its_normal_for_up(origin, up):
    """Pitched by more than 45 degrees, the axis nearest to its own y axis is level."""
    ball = {"type": "sphere", "center": [0, 0, 1], "bsdf": MATTE}
    look = sensor(origin, (0, 0, 0), up)
    assert free_space.up_axis(scene(ball=ball, ground=square(5), sensor=look)).tolist() == [0, 0, 1]


@pytest.mark.parametrize(
    "origin", [(0, 0, 4), (0, -1.5, 4), (0, 2, 4)], ids=["level", "upwards", "downwards"]
)
def test_a_wall_in_front_of_a_camera_is_no_ground(origin):
    ball = {"type": "sphere", "center": [0, -0.5, 0], "radius": 0.5, "bsdf": MATTE}
    shapes = {"wall": walls()["wall0"], "floor": lawn(-1, 1), "ball": ball}
    look = sensor(origin, (0, 0, 0))
    studio = scene(**shapes, sensor=look)
    assert free_space.up_axis(studio).tolist() == [0, 1, 0]
    house = scene(front=square(1, z=1), rest=box((0, 0, 0), 0.99), sensor=look)
    assert free_space.up_axis(house).tolist() == [0, 1, 0]


@pytest.mark.parametrize("up", [1, 2, 0])
def test_without_a_camera_what_all_stands_on_is_the_ground(up):
    """Imported scenes have no camera, and Blender's have z up: the ground is not the scene."""
    normal = np.eye(3)[up]
    to_world = mi.ScalarTransform4f().look_at([0, 0, 0], list(normal), list(np.roll(normal, 1)))
    ground = {"type": "rectangle", "to_world": to_world.scale(60), "bsdf": MATTE}
    ball = {"type": "sphere", "center": list(normal), "bsdf": MATTE}
    found = scene(ball=ball, ground=ground)
    low, high, diagonal = free_space.extent(found)
    np.testing.assert_allclose([low, high], [normal - 1, normal + 1], atol=1e-4)
    assert diagonal == pytest.approx(math.sqrt(12))


def test_meters_on_surfaces_have_no_rays_and_say_nothing():
    """They measure what falls on a shape: Mitsuba cannot be asked what they see."""
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    meter = {"type": "irradiancemeter", "film": film}
    ball = {"type": "sphere", "bsdf": MATTE, "meter": meter}
    found = scene(ball=ball, sensor=sensor((0, 0, 5), (0, 0, 0)))
    assert len(found.sensors()) == 2
    assert free_space.up_axis(found).tolist() == [0, 1, 0]
    np.testing.assert_allclose(free_space.sensor_eyes(found), [[0, 0, 5]], atol=1e-3)
    assert len(free_space.sensor_probes(found, 0))
    assert not is_room(found)


def test_up_is_told_by_a_camera_and_not_by_a_light_meter():
    to_world = mi.ScalarTransform4f().look_at([3, 0, 0], [0, 0, 0], [0, 1, 0])
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}}
    meter = {"type": "radiancemeter", "to_world": to_world, "film": film}
    camera = sensor((2, 3, 1), (0, 0, 0), (0, 0, 1))
    both = scene(ball={"type": "sphere"}, meter=meter, sensor=camera)
    assert len(both.sensors()) == 2
    assert free_space.up_axis(both).tolist() == [0, 0, 1]


def test_an_object_is_seen_from_the_upper_hemisphere(ball):
    placed = place_object(ball, 12, 4)
    assert [split for split, _ in placed] == ["train"] * 12 + ["heldout"] * 4
    eyes = np.array([look_at.origin for _, look_at in placed]) - [1, 2, 3]
    distance = np.linalg.norm(eyes, axis=1)
    assert np.allclose(distance, distance[0])
    # The ball just fits into the image
    assert 2 < distance[0] * math.sin(math.radians(20)) < 1.1 * 2
    assert (eyes[:, 1] > 0).all()
    assert all(np.allclose(look_at.target, [1, 2, 3]) for _, look_at in placed)
    height = eyes[:, 1] / distance
    for heights in (height[:12], height[12:]):
        assert heights.min() < 0.3 and heights.max() > 0.7
    octants = {(x > 0, z > 0) for x, _, z in eyes[:12]}
    assert len(octants) == 4
    assert place_object(ball, 12, 4) == placed
    assert place_object(ball, 12, 4, seed=1) != placed
    assert coverage(ball, [placed[0][1].camera(8, 8)], 2000) > 0


def test_coverage_is_the_fraction_of_area_in_sight():
    empty = scene(**walls(), sensor=sensor((0, 0, 0), (0, 0, 1)))

    def seen(*directions):
        """Coverage by square views from the centre, each of which shows exactly one wall."""
        ups = [(0, 1, 0) if d[1] == 0 else (1, 0, 0) for d in directions]
        views = [
            Camera.look_at((0, 0, 0), d, up, 90.0, 8, 8)
            for d, up in zip(directions, ups, strict=True)
        ]
        return coverage(empty, views, 5000)

    axes = [tuple(sign * row) for row in np.eye(3) for sign in (1, -1)]
    assert seen() == 0.0
    assert seen(axes[4]) == pytest.approx(1 / 6, abs=0.02)
    assert seen(axes[4], axes[4]) == seen(axes[4])
    assert seen(*axes) == pytest.approx(1.0, abs=2e-3)
    ball = scene(ball={"type": "sphere", "bsdf": MATTE})
    far = Camera.look_at((0, 0, 4), (0, 0, 0), (0, 1, 0), 60.0, 8, 8)
    assert coverage(ball, [far], 5000) == pytest.approx((1 - 1 / 4) / 2, abs=0.02)


def test_what_nobody_can_see_does_not_count(room):
    # The cupboard stands on the floor and hides some of it; its own inside is no surface to see
    train = [
        Camera.look_at((-0.6, 0.5, -0.6), t, (0, 1, 0), 170.0, 8, 8)
        for t in ((1, 0, 1), (-1, 0, -1), (1, 0.1, -1), (-1, 0, 1))
    ]
    assert coverage(room, train, 4000) > 0.9


def test_small_shapes_get_more_points_when_asked_for():
    both = scene(large=walls()["wall0"], small=box((0, 0, 5), 0.1))
    shares = []
    for power in (1.0, 0.5):
        points = free_space.sample_surface(both, 4000, 0, power)
        shares.append((points.position[:, 2] > 1).mean())
        assert np.allclose(np.linalg.norm(points.normal, axis=1), 1)
    areas = np.array([4.0, 0.24])
    assert shares[0] == pytest.approx(areas[1] / areas.sum(), abs=0.015)
    assert shares[1] == pytest.approx(areas[1] ** 0.5 / (areas**0.5).sum(), abs=0.03)


@pytest.mark.parametrize("placed_as", [place_room, place_object])
def test_no_views_are_refused(room, placed_as):
    with pytest.raises(UserError, match="0 training"):
        placed_as(room, 0, 1)
    with pytest.raises(UserError, match="-1 held-out"):
        placed_as(room, 1, -1)


def test_scenes_that_no_camera_fits_into_are_refused():
    with pytest.raises(UserError, match="no free space"):
        place_room(scene(wall=walls()["wall0"]), 2, 1)
    with pytest.raises(UserError, match="no room for 90000 cameras"):
        place_room(scene(**walls()), 90000, 0)
    with pytest.raises(UserError, match="no shapes"):
        place_object(scene(sky={"type": "constant"}), 2, 1)


def test_cameras_of_a_file_say_whether_they_stand_in_a_room():
    """The scene's own sensor shows the house from outside."""
    house = scene(**walls(), outside=sensor([0, 0, 6], [0, 0, 0]))
    assert not is_room(house)
    inside = Camera.look_at([0, 0, 0.8], [0, 0, 0], [0, 1, 0], 60.0, 8, 8)
    outside = Camera.look_at([0, 0, 6], [0, 0, 0], [0, 1, 0], 60.0, 8, 8)
    assert is_room(house, [inside]) and not is_room(house, [outside])
    thing = scene(thing=box([0, 0, 0], 0.3), front=sensor([0, 0, 0.9], [0, 0, 0]))
    assert not is_room(thing, [inside])


def lamp(centre, scale, target):
    """A rectangle at `centre` that emits light towards `target`."""
    to_world = mi.ScalarTransform4f().look_at(list(centre), list(target), [0, 1, 0]).scale(scale)
    light = {"type": "area", "radiance": {"type": "rgb", "value": 5.0}}
    return {"type": "rectangle", "to_world": to_world, "bsdf": MATTE, "light": light}


def lawn(height, half):
    to_world = mi.ScalarTransform4f().translate([0, height, 0]).rotate([1, 0, 0], -90).scale(half)
    return {"type": "rectangle", "to_world": to_world, "bsdf": MATTE}


def test_a_house_on_a_lawn_has_rooms_as_large_as_without():
    inside = sensor((-0.6, 0, -0.6), (0, 0, 0))
    alone = scene(**walls(), sensor=inside)
    house = scene(**walls(), lawn=lawn(-1.01, 50), sensor=inside)
    assert free_space.bounds(house)[2] > 100
    for one, other in zip(free_space.extent(house), free_space.extent(alone), strict=True):
        np.testing.assert_allclose(one, other)
    placed = place_room(house, 6, 2)
    eyes = np.array([look_at.origin for _, look_at in placed])
    assert (np.abs(eyes) < 1).all()
    cameras = [look_at.camera(16, 16) for _, look_at in placed]
    assert check_cameras(house, {str(i): camera for i, camera in enumerate(cameras)}) == []
    assert is_room(house, cameras)


def test_a_scene_without_ground_is_all_of_it(room, ball):
    for one, other in zip(free_space.extent(room), free_space.bounds(room), strict=True):
        np.testing.assert_array_equal(one, other)
    low, high, _ = free_space.extent(ball)
    np.testing.assert_allclose([low, high], [[-1, 0, 1], [3, 4, 5]], atol=1e-5)
    flat = scene(first=lawn(0, 1), second=lawn(0.1, 50), sensor=sensor((0, 3, 3), (0, 0, 0)))
    np.testing.assert_array_equal(free_space.extent(flat)[0], free_space.bounds(flat)[0])


def test_lamps_around_an_object_do_not_move_its_cameras():
    """A softbox at either side, as photographers have them."""
    thing = {"type": "sphere", "center": [0, 1, 0], "radius": 1, "bsdf": MATTE}
    look = sensor((0, 2, 6), (0, 1, 0))
    lamps = {f"lamp{x}": lamp((x, 9, 8), 1.5, (0, 1, 0)) for x in (-9, 9)}
    dark = scene(thing=thing, floor=lawn(0, 40), sensor=look)
    lit = scene(thing=thing, floor=lawn(0, 40), sensor=look, **lamps)
    for (_, one), (_, other) in zip(place_object(lit, 8, 2), place_object(dark, 8, 2), strict=True):
        np.testing.assert_allclose(one.origin, other.origin, rtol=1e-5)
        np.testing.assert_allclose(one.target, (0, 1, 0), atol=1e-5)


def test_an_object_on_a_large_floor_fits_into_its_pictures():
    """By area, all points would lie on the floor, and none on a long thing upon it."""
    to_world = mi.ScalarTransform4f().translate([0, 0.4, 0]).scale([3, 0.4, 0.4])
    thing = {"type": "cube", "to_world": to_world, "bsdf": MATTE}
    small = scene(thing=thing, sensor=sensor((0, 3, 9), (0, 0, 0)))
    large = scene(thing=thing, floor=lawn(0, 3000), sensor=sensor((0, 3, 9), (0, 0, 0)))
    for (_, one), (_, other) in zip(
        place_object(large, 8, 2), place_object(small, 8, 2), strict=True
    ):
        np.testing.assert_allclose(one.origin, other.origin, rtol=1e-3)


def test_coverage_in_a_room_is_that_of_the_room_whatever_the_scene_s_own_sensor_shows():
    house = scene(**walls(), outside=sensor([0, 0, 6], [0, 0, 0]))
    cameras = [
        Camera.look_at((0, 0, 0), d, (0, 1, 0) if d[1] == 0 else (1, 0, 0), 90.0, 8, 8)
        for d in [tuple(sign * row) for row in np.eye(3) for sign in (1, -1)]
    ]
    assert coverage(house, cameras, 4000) == pytest.approx(1, abs=0.01)
    # The walls' outer sides are the same surfaces, which a camera outside sees.
    assert coverage(house, cameras[:1], 4000) == pytest.approx(1 / 6, abs=0.03)


def test_a_room_without_a_material_to_fit_is_refused():
    glass = {"type": "dielectric"}
    bare = {name: wall | {"bsdf": glass} for name, wall in walls().items()}
    with pytest.raises(UserError, match="no surface has a material to fit"):
        place_room(scene(**bare, sensor=sensor((-0.6, 0, -0.6), (0, 0, 0))), 2, 1)


def test_backs_of_one_sided_materials_are_told():
    def share(bsdf, eye):
        wall = {"type": "rectangle", "bsdf": bsdf}
        return black_share(
            scene(wall=wall), [Camera.look_at(eye, (0, 0, 0), (0, 1, 0), 30.0, 8, 8)]
        )

    matte, front, back = {"type": "principled"}, (0, 0, 3), (0, 0, -3)
    assert share(matte, back) == 1 and share(matte, front) == 0
    assert share(MATTE, back) == 0
    assert share({"type": "roughconductor"}, back) == 0, "that is known"


@pytest.mark.parametrize("flipped", [False, True])
def test_cameras_of_an_object_stand_in_front_of_its_backdrop(flipped):
    """A spiral has half of its cameras behind it, where they see its back."""
    ball = {"type": "sphere", "bsdf": MATTE}
    to_world = mi.ScalarTransform4f().translate([0, 0, -2]).scale([4, 3, 1])
    drop = {"type": "rectangle", "to_world": to_world, "bsdf": MATTE, "flip_normals": flipped}
    placed = place_object(scene(ball=ball, drop=drop, sensor=sensor((0, 1, 9), (0, 0, 0))), 12, 4)
    assert [split for split, _ in placed] == ["train"] * 12 + ["heldout"] * 4
    eyes = np.array([look_at.origin for _, look_at in placed])
    assert (eyes[:, 2] > -2).all() and len(np.unique(eyes, axis=0)) == 16
    away = np.linalg.norm(eyes - placed[0][1].target, axis=1)
    assert np.allclose(away, away[0])
    height = eyes[:, 1] / away
    assert (eyes[:, 0] > 2).any() and (eyes[:, 0] < -2).any()
    assert height.min() < 0.3 and height.max() > 0.7
    # Nothing tells the front without a sensor.
    untold = place_object(scene(ball=ball, drop=drop), 12, 4)
    assert any(look_at.origin[2] < -2 for _, look_at in untold)


@pytest.mark.parametrize("thickness", [0.04, 0.4, 2.0])
def test_no_camera_of_an_object_stands_behind_a_thick_backdrop(thickness):
    """A closed box, whose far side no sensor sees, turned so that it is along no axis."""
    turn = mi.ScalarTransform4f().rotate([0, 1, 0], 30)
    to_world = turn.translate([0, 0, -2 - thickness / 2]).scale([4, 3, thickness / 2])
    drop = {"type": "cube", "to_world": to_world, "bsdf": MATTE}
    ball = {"type": "sphere", "bsdf": MATTE}
    look = sensor((4.5, 1, 7.8), (0, 0, 0))
    placed = place_object(scene(ball=ball, drop=drop, sensor=look), 12, 4)
    ahead = np.array([math.sin(math.radians(30)), 0, math.cos(math.radians(30))])
    eyes = np.array([look_at.origin for _, look_at in placed])
    assert len(np.unique(eyes, axis=0)) == 16
    # Beside a thick one, cameras see the ball and a side of the box.
    assert (eyes @ ahead > -2 - thickness / 2).all()
    untold = place_object(scene(ball=ball, drop=drop), 12, 4)
    assert sum(look_at.origin @ ahead < -2 - thickness for _, look_at in untold) > 3


def test_the_back_of_a_thick_thing_is_photographed_where_nothing_stands_before_it():
    """A television: its screen is as wide as it, and flush with it."""
    case = {"type": "cube", "to_world": mi.ScalarTransform4f().scale([2, 1, 0.1]), "bsdf": MATTE}
    to_world = mi.ScalarTransform4f().translate([0, 0, 0.11]).scale([1.8, 0.9, 1])
    screen = {"type": "rectangle", "to_world": to_world, "bsdf": MATTE}
    seen = place_object(scene(a=case, b=screen, sensor=sensor((0, 1, 9), (0, 0, 0))), 12, 4)
    assert seen == place_object(scene(a=case, b=screen), 12, 4)


def test_an_open_vessel_is_seen_from_all_around():
    """Its sensor sees its inside alone, which only cameras straight above it would see as well."""
    sides = {name: wall for name, wall in walls().items() if name != "wall4"}
    vessel = scene(**sides, sensor=sensor((0, 6, 1), (0, 0, 0)), floor=lawn(-1.01, 6))
    placed = place_object(vessel, 12, 4)
    eyes = np.array([look_at.origin for _, look_at in placed])
    height = (eyes - placed[0][1].target)[:, 1] / np.linalg.norm(eyes - placed[0][1].target, axis=1)
    assert height.min() < 0.2 and height.max() > 0.8
    assert len(np.unique(np.sign(eyes[height < 0.5][:, [0, 2]]), axis=0)) == 4


THINGS = {
    "ball": {"type": "sphere", "bsdf": MATTE},
    "one-sided cube": {"type": "cube", "bsdf": MATTE["bsdf"]},
    "cup": {"type": "cylinder", "p0": [0, -1, 0], "p1": [0, 1, 0], "bsdf": MATTE},
}


@pytest.mark.parametrize("name", THINGS)
@pytest.mark.parametrize("eye", [(0, 3, 4), (3, 1, 5), (2, 4, -1)])
def test_an_object_that_can_be_seen_all_round_keeps_its_cameras(name, eye):
    """Its sensor sees one side of it, and inner sides of a cup."""
    thing = THINGS[name]
    seen = place_object(scene(thing=thing, sensor=sensor(eye, (0, 0, 0))), 20, 4)
    assert seen == place_object(scene(thing=thing), 20, 4)


def test_a_large_floor_does_not_count_in_the_coverage_of_an_object():
    """It was 3 % of a hundred metres of floor."""
    ball = {"type": "sphere", "center": [0, 1, 0], "bsdf": MATTE}
    look = sensor((0, 2, 6), (0, 1, 0))
    stage = scene(ball=ball, floor=lawn(0, 50), sensor=look)
    cameras = [look_at.camera(32, 32) for _, look_at in place_object(stage, 12, 0)]
    assert coverage(stage, cameras, 4000) > 0.8
    assert (view_counts(stage, cameras, 4000, hide_emitters=True) > 0).mean() > 0.8
    # A floor that is all there is counts.
    above = Camera.look_at((0, 4, 0.1), (0, 0, 0), (0, 1, 0), 60.0, 32, 32)
    assert coverage(scene(floor=lawn(0, 1), sensor=look), [above], 2000) > 0.95


def fence(opacity):
    """A square of half an edge of 2 before one of half an edge of 1, cut out where x > 0."""
    solid = np.full((64, 64, 1), opacity, np.float32)
    solid[:, :32] = 1
    picture = {
        "type": "bitmap",
        "raw": True,
        "filter_type": "nearest",
        "bitmap": mi.Bitmap(solid),
    }
    to_world = mi.ScalarTransform4f().translate([0, 0, 1]).scale([2, 2, 1])
    bsdf = {"type": "mask", "opacity": picture, "bsdf": MATTE}
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}


@pytest.mark.parametrize(("opacity", "area", "seen"), [(0.0, 4 + 8, 2 + 8), (0.8, 4 + 16, 16)])
def test_holes_are_no_surface_and_hide_none(opacity, area, seen):
    """Half of a wall is seen through half of a fence."""
    wall = {"type": "rectangle", "bsdf": MATTE}
    stage = scene(wall=wall, fence=fence(opacity))
    camera = Camera.look_at((0, 0, 60), (0, 0, 0), (0, 1, 0), 5.0, 32, 32)
    assert coverage(stage, [camera], 8000) == pytest.approx(seen / area, abs=0.03)
    counts = view_counts(stage, [camera, camera], 4000, hide_emitters=True)
    assert (counts == 2).mean() == pytest.approx(seen / area, abs=0.03)
    assert set(counts) == {0, 2}


def test_lamps_hide_what_photographs_show_behind_them_only_where_they_show_lamps():
    ball = {"type": "sphere", "bsdf": MATTE}
    lit = lamp((0, 0, 3), 2, (0, 0, 0))
    stage = scene(ball=ball, lamp=lit)
    camera = Camera.look_at((0, 0, 9), (0, 0, 0), (0, 1, 0), 40.0, 32, 32)
    cap = (1 - 1 / 9) / 2
    assert coverage(stage, [camera], 4000) == pytest.approx(cap, abs=0.03)
    for hidden, expected in ((True, cap), (False, 0)):
        counts = view_counts(stage, [camera], 4000, hide_emitters=hidden)
        assert (counts > 0).mean() == pytest.approx(expected, abs=0.03)
