"""Batches: rays go through the right pixels, which come with their own targets, evenly drawn."""

import gc
import tracemalloc
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from unbake.dataset.camera import Camera
from unbake.dataset.decoding import fill_rows, joined, stretch
from unbake.dataset.photographs import Photographs
from unbake.dataset.pixels import (
    _AT_ONCE,
    CameraRays,
    PixelSource,
    _Places,
    crop_edges,
    largest_crop,
)
from unbake.errors import UserError

SIZES = [(5, 3), (4, 4), (1, 7), (6, 2)]


def cameras():
    """Four views of different sizes, poses and lenses."""
    rng = np.random.default_rng(3)
    views = []
    for index, (width, height) in enumerate(SIZES):
        view = Camera.look_at(rng.normal(size=3) * 3, (0.1, 0.2, 0), (0, 1, 0.1), 50, width, height)
        # Off-centre principal points
        views.append(
            Camera(
                view.to_world,
                view.fl_x,
                view.fl_y,
                view.cx + 0.3 * index,
                view.cy - 0.2 * index,
                width,
                height,
            )
        )
    return views


def numbered():
    """For each pixel of all views: its view, column and row."""
    return [
        (view, x, y)
        for view, (width, height) in enumerate(SIZES)
        for y in range(height)
        for x in range(width)
    ]


def rows(vector):
    return np.array(vector).T


def sampler(lanes, seed=0):
    made = mi.load_dict({"type": "independent"})
    made.seed(seed, lanes)
    return made


def drawn(source, seed, pixels, spp):
    """A batch."""
    return source.draw(seed, pixels).batch(source.rays, sampler(spp * pixels, seed), spp)


@pytest.fixture
def source():
    """Pixels whose colour is their number, and which are foreground where that is odd."""

    def make(foreground_only=False):
        number = np.arange(len(numbered()))
        rgb = np.stack([number, 100 + number, 200 + number], 1).astype(np.float32)
        alpha = (number % 2).astype(np.float32)
        return PixelSource.of(cameras(), rgb, alpha, foreground_only=foreground_only)

    return make


def test_rays_are_those_of_mitsubas_perspective_camera():
    views, pixels = cameras(), numbered()
    offset = np.random.default_rng(1).random((2, len(pixels))).astype(np.float32)
    ray = CameraRays.of(views).through(
        mi.UInt32(np.arange(len(pixels))), mi.Point2f(mi.Float(offset[0]), mi.Float(offset[1]))
    )
    for index, (view, x, y) in enumerate(pixels):
        camera = views[view]
        sensor = mi.load_dict(camera.sensor(1))
        film = mi.Point2f(
            (x + float(offset[0, index])) / camera.width,
            (y + float(offset[1, index])) / camera.height,
        )
        expected, _ = sensor.sample_ray(0.0, 0.5, film, mi.Point2f(0.5))
        assert np.allclose(rows(ray.d)[index], rows(expected.d)[0], atol=2e-5)
        # Mitsuba's rays start on the near plane
        way = rows(expected.o)[0] - rows(ray.o)[index]
        assert np.abs(np.cross(way, rows(ray.d)[index])).max() < 1e-4
    assert np.allclose(np.linalg.norm(rows(ray.d), axis=1), 1, atol=1e-6)


def test_rays_are_those_of_the_camera():
    views, pixels = cameras(), numbered()
    ray = CameraRays.of(views).through(mi.UInt32(np.arange(len(pixels))), mi.Point2f(0.25, 0.75))
    for index, (view, x, y) in enumerate(pixels):
        origin, direction = views[view].rays(np.array([x + 0.25]), np.array([y + 0.75]))
        assert np.allclose(rows(ray.d)[index], direction[0], atol=1e-6)
        assert np.allclose(rows(ray.o)[index], origin[0], atol=1e-6)


def pixel_of(ray_d, ray_o, views):
    """The number of the pixel that a ray goes through."""
    first = np.cumsum([0, *(w * h for w, h in SIZES)])
    view = int(np.argmin([np.linalg.norm(ray_o - v.origin) for v in views]))
    camera = views[view]
    x, y, z = camera.to_world[:3, :3].T @ ray_d.astype(np.float64)
    column = camera.cx + camera.fl_x * x / -z
    row = camera.cy - camera.fl_y * y / -z
    return first[view] + int(row) * camera.width + int(column)


@pytest.mark.parametrize("foreground_only", [False, True])
def test_targets_are_the_pixels_that_the_rays_go_through(source, foreground_only):
    views, spp, pixels = cameras(), 3, 200
    batch = drawn(source(foreground_only), 5, pixels, spp)
    target = rows(batch.target)
    assert target.shape == (pixels, 3) and dr.width(batch.ray) == spp * pixels
    assert np.array_equal(target[:, 1:] - target[:, :1], np.tile([100, 200], (pixels, 1)))
    directions, origins = rows(batch.ray.d), rows(batch.ray.o)
    for lane in range(spp * pixels):
        assert pixel_of(directions[lane], origins[lane], views) == target[lane // spp, 0]
    if foreground_only:
        assert (target[:, 0] % 2 == 1).all()


def test_samples_fill_their_pixel_evenly(source):
    views, spp = cameras(), 4096
    batch = drawn(source(), 2, 1, spp)
    number = int(rows(batch.target)[0, 0])
    view, x, y = numbered()[number]
    camera = views[view]
    local = rows(batch.ray.d).astype(np.float64) @ camera.to_world[:3, :3]
    across = camera.cx + camera.fl_x * local[:, 0] / -local[:, 2] - x
    down = camera.cy - camera.fl_y * local[:, 1] / -local[:, 2] - y
    for place in (across, down):
        assert place.min() > -1e-4 and place.max() < 1 + 1e-4
        counts = np.histogram(place, bins=8, range=(0, 1))[0]
        assert np.abs(counts - spp / 8).max() < 5 * np.sqrt(spp / 8)


@pytest.mark.parametrize("foreground_only", [False, True])
def test_all_pixels_are_drawn_equally_often(source, foreground_only):
    made, pixels = source(foreground_only), 1000
    counts = np.zeros(len(numbered()))
    for seed in range(20):
        batch = drawn(made, seed, pixels, 1)
        numbers, times = np.unique(rows(batch.target)[:, 0].astype(int), return_counts=True)
        counts[numbers] += times
    chosen = np.arange(len(counts)) % 2 == 1 if foreground_only else np.ones(len(counts), bool)
    assert counts[~chosen].sum() == 0
    expected = 20 * pixels / chosen.sum()
    # χ² with as many degrees of freedom as pixels, less one: mean k and variance 2 k
    freedom = chosen.sum() - 1
    chi2 = ((counts[chosen] - expected) ** 2 / expected).sum()
    assert abs(chi2 - freedom) < 5 * np.sqrt(2 * freedom)


def test_seeds_decide_the_pixels(source):
    made = source()
    draws = [rows(drawn(made, s, 64, 1).target) for s in (1, 1, 2)]
    assert np.array_equal(draws[0], draws[1]) and not np.array_equal(draws[0], draws[2])


def test_one_view_of_one_pixel():
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 40, 1, 1)
    made = PixelSource.of(
        [camera], np.full((1, 3), 0.5, np.float32), np.ones(1), foreground_only=True
    )
    batch = drawn(made, 0, 2, 4)
    assert (rows(batch.target) == 0.5).all() and (rows(batch.ray.d)[:, 2] < -0.9).all()


# -------------------------------------------------------------------------------- one-view crops

EDGE = 3
CROP_SIZES = [(5, 4), (4, 6), (3, 3), (6, 5)]


def crop_source(alpha=None):
    """Views whose pixels have their number as colour; `alpha` is given by view, row and column."""
    views = [
        Camera.look_at((i, 0, 3), (0, 0, 0), (0, 1, 0), 50, w, h)
        for i, (w, h) in enumerate(CROP_SIZES)
    ]
    count = sum(w * h for w, h in CROP_SIZES)
    rgb = np.repeat(np.arange(count, dtype=np.float32)[:, None], 3, 1)
    opaque = np.ones(count) if alpha is None else np.concatenate([a.ravel() for a in alpha])
    return PixelSource.of(views, rgb, opaque, foreground_only=alpha is not None)


def corner(made, seed):
    """View, row and column of a crop's corner; checks that the rest is where it should be."""
    batch = made.draw_crop(seed, EDGE * EDGE).batch(made.rays, sampler(EDGE * EDGE), 1)
    numbers = rows(batch.target)[:, 0].astype(int)
    first = np.cumsum([0, *(w * h for w, h in CROP_SIZES)])
    view = int(np.searchsorted(first, numbers[0], "right")) - 1
    width, height = CROP_SIZES[view]
    row, column = divmod(numbers[0] - first[view], width)
    assert row + EDGE <= height and column + EDGE <= width
    y, x = np.mgrid[row : row + EDGE, column : column + EDGE]
    assert np.array_equal(numbers, first[view] + (y * width + x).ravel())
    return view, row, column


def assert_uniform(drawn, places):
    """χ² of what was drawn, over all views and, in each, over the places that it has."""
    share = {(v, *place): 1 / len(places) / len(own) for v, own in places.items() for place in own}
    assert set(drawn) <= set(share)
    expected = np.array([len(drawn) * p for p in share.values()])
    chi2 = ((np.array([drawn.count(place) for place in share]) - expected) ** 2 / expected).sum()
    freedom = len(share) - 1
    assert abs(chi2 - freedom) < 5 * np.sqrt(2 * freedom)


def all_places(view):
    width, height = CROP_SIZES[view]
    return [(y, x) for y in range(height - EDGE + 1) for x in range(width - EDGE + 1)]


def test_crops_lie_anywhere_in_any_view_equally_often():
    made = crop_source()
    assert_uniform(
        [corner(made, seed) for seed in range(2000)], {v: all_places(v) for v in range(4)}
    )


def test_half_of_a_crop_is_foreground():
    """In a view with too little of it, as much as there is; views without any are left out."""
    rng = np.random.default_rng(5)
    alpha = [(rng.random((h, w)) < 0.5).astype(float) for w, h in CROP_SIZES]
    alpha[0][:, :2] = 0
    alpha[1][:] = 0
    alpha[3][:] = 0
    alpha[3][2, 4:] = 1
    made = crop_source(alpha)
    inside = {
        v: {(y, x): alpha[v][y : y + EDGE, x : x + EDGE].sum() for y, x in all_places(v)}
        for v in (0, 2, 3)
    }
    places = {
        v: [place for place, seen in counts.items() if seen >= min(4.5, max(counts.values()))]
        for v, counts in inside.items()
    }
    assert 0 < len(places[0]) < len(inside[0]) and max(inside[3].values()) == 2
    assert_uniform([corner(made, seed) for seed in range(2000)], places)


def test_seeds_decide_the_crop():
    made = crop_source()
    crops = [corner(made, seed) for seed in (1, 1, *range(2, 9))]
    assert crops[0] == crops[1] and len(set(crops)) > 3


def test_a_crop_larger_than_a_view_is_told_in_one_line():
    made = crop_source()
    made.require_crops(9)
    with pytest.raises(UserError, match="4 x 4 pixels is larger than a photograph") as caught:
        made.require_crops(16)
    assert "--batch 9, or" in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(UserError, match=r"of each of 4 processes of 3 x 4 .* Use --batch 36, or"):
        made.require_crops(12, 4)
    with pytest.raises(UserError, match=r"cannot have 7 pixels: .* Use --batch 6, or"):
        made.require_crops(7)
    with pytest.raises(UserError, match=r"with --resume, as many processes as before"):
        made.require_crops(7)


def test_crops_are_as_near_to_squares_as_their_pixels_allow():
    edges = {1: (1, 1), 2: (1, 2), 9: (3, 3), 12: (3, 4), 2048: (32, 64), 16384: (128, 128)}
    assert {count: crop_edges(count) for count in edges} == edges
    assert crop_edges(3) is None and crop_edges(10) is None and largest_crop(11) == 9
    batches = [16384 // ranks for ranks in (1, 2, 4, 8, 16, 32, 64)]
    assert all(crop_edges(count) for count in batches)


@pytest.mark.parametrize("hidden", [False, True])
def test_crops_that_are_no_squares_lie_along_the_longer_edge_of_the_view(hidden):
    alpha = [np.ones((h, w)) for w, h in CROP_SIZES]
    alpha[0][:, :2] = 0
    made, views = crop_source(alpha if hidden else None), [0, 1, 3]
    vars(made)["_seen_views"] = np.array(views)  # the others are too small
    first = np.cumsum([0, *(w * h for w, h in CROP_SIZES)])
    seen = set()
    for seed in range(400):
        numbers = made.draw_crop(seed, 8).read()[0].astype(int)
        (view,) = set(np.searchsorted(first, numbers, "right") - 1)
        width, height = CROP_SIZES[view]
        rows, columns = (2, 4) if width > height else (4, 2)
        row, column = np.divmod(numbers - first[view], width)
        y, x = np.mgrid[row[0] : row[0] + rows, column[0] : column[0] + columns]
        assert np.array_equal(row, y.ravel()) and np.array_equal(column, x.ravel())
        assert row.max() < height and column.max() < width
        if hidden:
            assert alpha[view][row, column].sum() >= 4
        seen.add((view, row[0], column[0]))
    places = {v: (w - 3) * (h - 1) for v, (w, h) in enumerate(CROP_SIZES) if w > h}
    places[1] = (CROP_SIZES[1][1] - 3) * (CROP_SIZES[1][0] - 1)
    assert len(seen) == sum(places.values())


# ----------------------------------------------------------------------------------- held aside


@pytest.fixture
def large():
    """Pixels of two views, 40 x 20 each, whose colour is their number; a third are background."""

    def make(foreground_only=False):
        pose = cameras()[0].to_world
        views = [Camera(pose, 30, 30, 20, 10, 40, 20)] * 2
        number = np.arange(1600, dtype=np.float32)
        alpha = (number % 3 > 0).astype(np.float32)
        rgb = np.stack([number] * 3, 1)
        return PixelSource.of(views, rgb, alpha, foreground_only=foreground_only)

    return make


@pytest.mark.parametrize("foreground_only", [False, True])
def test_pixels_that_are_held_aside_are_never_drawn_and_all_others_are(large, foreground_only):
    every = large(foreground_only)
    source = every.holding_aside(0.25, seed=5)
    held, colours = source.held_aside().read()
    count = every.photographs.count // 4 // 16 * 16
    assert len(set(held.tolist())) == len(held) == count
    assert np.array_equal(colours[:, 0], held)
    if foreground_only:
        assert (held % 3 > 0).all()
    drawn = np.concatenate([source.draw(seed, 5000).read()[0] for seed in range(10)])
    assert not set(drawn.tolist()) & set(held.tolist())
    left = every.photographs.count - count
    numbers, times = np.unique(drawn, return_counts=True)
    assert len(numbers) == left
    # Each as often as any other: χ² within five standard deviations
    expected = len(drawn) / left
    assert abs(((times - expected) ** 2 / expected).sum() - left) < 5 * np.sqrt(2 * left)


def test_crops_have_no_pixel_that_is_held_aside(large):
    source = large().holding_aside(0.5, seed=1)
    held = set(source.held_aside().read()[0].tolist())
    for seed in range(50):
        numbers, colours = source.draw_crop(seed, 16).read()
        assert len(numbers) == 16 and not held & set(numbers.tolist())
        assert np.array_equal(colours[:, 0], numbers)
        assert not held & set(source.draw_crop(seed, 1).read()[0].tolist())


@pytest.mark.parametrize("aside", [0.0, 0.5])
def test_crops_have_no_pixel_that_is_masked(aside, large):
    """Background is in crops, as in the paper; what is masked is not."""
    source = large(True)
    masked = replace(source, photographs=replace(source.photographs, masked=True))
    counts = []
    for made in (source, masked):
        made = made.holding_aside(aside, seed=1)
        drawn = np.concatenate([made.draw_crop(seed, 16).read()[0] for seed in range(50)])
        assert len(drawn) == 50 * 16
        counts.append((drawn % 3 == 0).sum())
    assert counts[0] > 100 and counts[1] == 0


def test_the_seed_decides_what_is_held_aside(large):
    held = [large().holding_aside(0.1, seed).held.tolist() for seed in (3, 3, 4)]
    assert held[0] == held[1] != held[2]
    plain = large()
    assert plain.held_aside() is None
    # 2 % of these are 32, which tell nothing.
    assert plain.holding_aside(0.02, 0) is plain and plain.holding_aside(0.0, 0) is plain
    same = plain.draw(9, 50).read()[0], large().holding_aside(0.0, 1).draw(9, 50).read()[0]
    assert np.array_equal(*same)


# ------------------------------------------------------------------------------ memory of many

#: Pixels along an edge of a view of many, and bytes that are next to nothing beside these.
MANY, LITTLE = 1024, 50_000


def with_peak(work):
    """What some work comes to, and the memory in bytes that it takes at most."""
    # Python 3.11 crashes where a thread of Dr.Jit, which lets go of arrays, begins meanwhile.
    gc.collect()
    dr.sync_thread()
    tracemalloc.start()
    try:
        return work(), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.fixture
def many():
    """Three views of a million pixels, of which every second one counts, and none of the middle."""
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 50, MANY, MANY)
    chosen = np.arange(0, 3 * MANY**2, 2, dtype=np.uint32)
    chosen = chosen[(chosen < MANY**2) | (chosen >= 2 * MANY**2)]
    table = np.zeros((3 * MANY**2, 3), np.float32)
    return PixelSource(CameraRays.of([camera] * 3), Photographs(table, chosen, 0.0))


def test_numbers_are_looked_for_without_a_copy_of_all(many):
    found = many.photographs
    numbers = np.array([0, 1, MANY**2, 2 * MANY**2, 3 * MANY**2 - 1])
    counts, peak = with_peak(lambda: found.own_counts(numbers))
    assert counts.tolist() == [True, False, False, True, False] and peak < LITTLE
    part, peak = with_peak(lambda: stretch(found.chosen, MANY**2, 3 * MANY**2))
    assert part == slice(MANY**2 // 2, MANY**2) and peak < LITTLE
    views, peak = with_peak(lambda: many._seen_views)
    assert views.tolist() == [0, 2] and peak < LITTLE


def test_stretches_of_numbers_may_be_empty_or_end_beyond_32_bits():
    numbers = np.array([3, 5, 2**32 - 2], np.uint32)
    assert stretch(numbers, 4, 1 << 40) == slice(1, 3) and stretch(numbers, 6, 9) == slice(2, 2)
    assert stretch(numbers[:0], 0, 9) == slice(0, 0)


def test_pixels_that_count_are_marked_part_by_part(many):
    bits, peak = with_peak(lambda: many._counted)
    assert np.array_equal(np.flatnonzero(np.unpackbits(bits)), many.photographs.chosen)
    assert peak < 0.25 * len(many.photographs.table) + 1.5 * _AT_ONCE
    numbers = np.random.default_rng(2).integers(0, len(many.photographs.table), 999)
    wanted = np.isin(numbers, many.photographs.chosen)
    np.testing.assert_array_equal(many._counts(numbers), wanted)


def test_places_of_crops_are_kept_as_bits(many):
    inside = np.random.default_rng(3).random((37, 53)) < 0.3
    inside[5] = inside[-1] = False
    places = _Places.of(inside)
    kept = [places[number] for number in range(len(places))]
    assert kept == list(map(tuple, np.argwhere(inside).tolist()))
    of_view = many._places(0, 16)
    assert len(of_view) == (MANY - 3) ** 2 and of_view.bits.nbytes + of_view.ends.nbytes < MANY**2


def test_numbers_of_pixels_to_train_on_take_eight_bytes_each_while_they_are_read():
    edge, views = 64, 64
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 50, edge, edge)
    image = (camera, np.zeros((edge**2, 3), np.float32), np.ones(edge**2, bool), None)
    table = np.zeros((views * edge**2, 3), np.float32)

    def filled():
        for start in range(0, len(table), edge**2):
            yield fill_rows(table[start : start + edge**2], image, True, start)

    (chosen, _), peak = with_peak(lambda: joined(filled(), True))
    assert chosen.dtype == np.uint32 and np.array_equal(chosen, np.arange(len(table)))
    assert peak < 9.5 * len(table)
    # Where a file takes them, no more than those of a view.
    kept = []
    _, peak = with_peak(lambda: joined(filled(), True, lambda x: kept.append(x[0])))
    assert kept == list(range(0, len(table), edge**2)) and peak < 1.5 * len(table)
