"""Photographs that processes share: each holds whole views, and together they hold all."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from support import on_ranks

from unbake import memory
from unbake.dataset import decoding
from unbake.dataset import photographs as module
from unbake.dataset.camera import Camera
from unbake.dataset.photographs import Photographs
from unbake.dataset.pixels import CameraRays, PixelSource
from unbake.dataset.quick_check import _small_views
from unbake.dataset.shares import dealt
from unbake.dataset.views import Dataset, View
from unbake.errors import UserError
from unbake.ranks import Agreed

SIZES = [(7, 5), (12, 8), (6, 6), (20, 11), (9, 9)]


@pytest.fixture
def dataset(tmp_path):
    """Five views of as many sizes; the third sees no foreground, and the last one has a mask."""

    def make(background="hidden", masked=True):
        rng = np.random.default_rng(4)
        views = []
        for i, (width, height) in enumerate(SIZES):
            camera = Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 40, width, height)
            rgba = rng.uniform(0, 2, (height, width, 4)).astype(np.float32)
            rgba[..., 3] = 0 if i == 2 else rng.random((height, width)) > 1 / 3
            image, mask = tmp_path / f"{i}.exr", None
            mi.Bitmap(rgba).write(str(image))
            if masked and i == 4:
                mask = tmp_path / f"{i}-mask.png"
                codes = np.where(rng.random((height, width)) > 0.5, 255, 0).astype(np.uint8)
                mi.Bitmap(codes[..., None]).write(str(mask))
            views.append(View(f"{i}", "train", camera, image, {}, mask=mask))
        views[3] = replace(views[3], exposure=2.0, clipped=1.5)
        return Dataset(tmp_path, tmp_path / "s.xml", background, views, {}, None)

    return make


def source(photographs, dataset, **more):
    rays = CameraRays.of([view.camera for view in dataset.train])
    limits = np.array([view.limit for view in dataset.train], np.float32)
    return PixelSource(rays, photographs, limits=limits, **more)


def loaded(dataset, count, **more):
    """The photographs that each of several ranks holds."""
    return on_ranks(count, lambda ranks: Photographs.load(dataset, False, ranks=ranks, **more))


@pytest.mark.parametrize("ranks", [1, 2, 3, 4, 7, 30])
@pytest.mark.parametrize("kind", ["alike", "random", "one is large"])
def test_views_are_dealt_whole_and_about_equally(ranks, kind):
    sizes = np.random.default_rng(1).integers(1, 1000, 30) if kind == "random" else np.ones(30, int)
    if kind == "one is large":
        sizes[11] = 10_000
    first = dealt(sizes, ranks)
    assert len(first) == ranks + 1 and first[0] == 0 and first[-1] == 30
    assert (np.diff(first) >= 1).all()
    each = np.diff(np.cumsum([0, *sizes])[first])
    if kind == "alike":
        assert each.max() - each.min() <= 1
    elif kind == "random" and ranks < 10:
        assert np.abs(each - each.mean()).max() <= sizes.max()


@pytest.mark.parametrize("where", ["memory", "disk", "a file that is there"])
@pytest.mark.parametrize("background", ["hidden", "visible"])
def test_a_process_holds_its_views_alone(dataset, background, where, monkeypatch):
    made, read = dataset(background), []
    decode = decoding.read_masked
    whole = Photographs.load(made, False)
    monkeypatch.setattr(decoding, "read_masked", lambda *a: read.append(a[0].name) or decode(*a))
    if where != "memory":
        monkeypatch.setattr(module, "IN_MEMORY", 0)
    if where == "a file that is there":
        Photographs.load(made, False)
        read.clear()
    parts = loaded(made, 3)
    assert sorted(read) == ([] if where == "a file that is there" else list("01234"))
    for name in ("table", "chosen"):
        together = np.concatenate([getattr(part, name) for part in parts])
        np.testing.assert_array_equal(together, getattr(whole, name))
    for rank, part in enumerate(parts):
        assert len(part.table) == len(part.pixels) < 0.6 * len(whole.table)
        assert isinstance(part.table, np.memmap) == (where != "memory")
        assert part.mean == whole.mean and part.count == whole.count
        assert part.share.ranks.rank == rank


def test_hot_pixels_are_told_of_all_views(dataset, monkeypatch):
    made = dataset("visible", masked=False)
    pixels = np.array(mi.Bitmap(str(made.train[3].image)))
    pixels[4, 5, :3] = 1e9
    mi.Bitmap(pixels).write(str(made.train[3].image))
    whole = Photographs.load(made, False).hot_pixels
    assert [found.view for found in whole] == ["3"]
    for limit in (module.IN_MEMORY, 0):
        monkeypatch.setattr(module, "IN_MEMORY", limit)
        assert all(part.hot_pixels == whole for part in loaded(made, 2))


def test_processes_of_one_machine_share_its_memory(dataset, monkeypatch):
    made = dataset()
    monkeypatch.setattr(memory, "free_bytes", lambda: 40_000)
    Photographs.load(made, False)

    def load(ranks):
        with pytest.raises(Agreed, match="the photographs need about 0 MB of memory"):
            Photographs.load(made, False, ranks=ranks)

    on_ranks(3, load)


def test_an_image_that_cannot_be_read_ends_all(dataset):
    made = dataset()
    made.train[4].image.write_bytes(b"no image")

    def load(ranks):
        with pytest.raises(Agreed, match="process 2: ") as caught:
            ranks.together(lambda: Photographs.load(made, False, ranks=ranks))
        return caught.value.where

    assert all(where.endswith("4.exr") for where in on_ranks(3, load))


def test_what_fails_on_one_rank_before_others_ask_it_is_told_by_all():
    def work(ranks):
        if ranks.rank == 1:
            raise UserError("bad")
        return ranks.joined(lambda: np.zeros(3))

    def begin(ranks):
        with pytest.raises(Agreed, match="process 1: bad"):
            ranks.together(lambda: work(ranks))

    on_ranks(3, begin)


def test_pixels_of_any_view_can_be_looked_up(dataset):
    made = dataset()
    whole, rng = Photographs.load(made, False), np.random.default_rng(2)
    places = rng.integers(0, whole.count, 50)
    numbers = rng.integers(0, len(whole.table), 70)

    def look(ranks):
        part = Photographs.load(made, False, ranks=ranks)
        return part.numbers(places), part.radiance(numbers)

    for found, light in on_ranks(4, look):
        np.testing.assert_array_equal(found, whole.chosen[places])
        np.testing.assert_array_equal(light, whole.table[numbers, :3])

    def differ(ranks):
        part = Photographs.load(made, False, ranks=ranks)
        with pytest.raises(Agreed, match="other pixels to look at on process 1"):
            part.radiance(numbers[ranks.rank :])

    on_ranks(2, differ)


@pytest.mark.parametrize("background", ["hidden", "visible"])
@pytest.mark.parametrize("masked", [False, True])
def test_whether_pixels_of_any_view_count_can_be_looked_up(dataset, background, masked):
    made = dataset(background, masked)
    whole = Photographs.load(made, False)
    numbers = np.random.default_rng(2).permutation(len(whole.table))
    expected = np.ones(len(numbers), bool)
    if whole.chosen is not None:
        expected = np.isin(numbers, whole.chosen)
    assert expected.all() == (background == "visible" and not masked)

    def counts(ranks):
        return Photographs.load(made, False, ranks=ranks).counts(numbers)

    for found in (whole.counts(numbers), *on_ranks(5, counts)):
        assert found.dtype == bool
        np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("background", ["hidden", "visible"])
def test_small_views_are_made_by_those_that_hold_them(dataset, background):
    made = dataset(background)

    def small(ranks):
        return _small_views(made.train, Photographs.load(made, False, ranks=ranks), [0, 1, 3, 4])

    (alone,) = on_ranks(1, small)
    assert [view.name for view in alone] == ["0", "1", "3", "4"]
    for views in on_ranks(3, small):
        for view, other in zip(views, alone, strict=True):
            assert view.name == other.name
            np.testing.assert_array_equal(view.rgb, other.rgb)
            np.testing.assert_array_equal(view.alpha, other.alpha)


@pytest.mark.parametrize("slopes", [False, True])
@pytest.mark.parametrize("background", ["hidden", "visible"])
def test_the_same_pixels_are_held_aside_however_many_processes_there_are(
    dataset, background, slopes
):
    made = dataset(background)

    def held(ranks):
        photographs = Photographs.load(made, False, ranks=ranks)
        found = source(photographs, made, slopes=slopes).holding_aside(0.4, 5)
        return np.array(found.held_aside()._packed)

    (whole,) = on_ranks(1, held)
    assert len(whole) >= 64 * 7
    for count in (2, 3, 5):
        for packed in on_ranks(count, held):
            np.testing.assert_array_equal(packed, whole)


@pytest.mark.parametrize("held", [0.0, 0.4])
@pytest.mark.parametrize("background", ["hidden", "visible"])
@pytest.mark.parametrize("count", [2, 3, 5])
def test_draws_of_all_processes_are_fair_by_their_weights(dataset, background, held, count):
    made = dataset(background)
    whole = source(Photographs.load(made, False), made).holding_aside(held, 5)
    left = whole.photographs.own_numbers(np.arange(whole.photographs.count))
    if held:
        left = np.setdiff1d(left, whole.held_aside().read()[0])
    seen, weights, batch = np.zeros(len(whole.photographs.table)), [], 20_000
    for rank, photographs in enumerate(loaded(made, count)):
        own = source(photographs, made).holding_aside(held, 5)
        weights.append(own.weight(crops=False))
        numbers, colours = own.draw(rank, batch).read()
        assert set(numbers.tolist()) <= set(photographs.pixels)
        np.testing.assert_array_equal(colours, whole.photographs.table[numbers])
        np.add.at(seen, numbers, weights[-1] / count / batch)
        # Exactly: as likely in the mean over processes as in a batch of one
        drawn = np.intersect1d(left, np.array(photographs.pixels))
        if weights[-1]:
            assert weights[-1] / count / len(drawn) == pytest.approx(1 / len(left))
            assert len(np.unique(numbers)) == len(drawn)
        else:
            assert not len(drawn)
    assert np.mean(weights) == pytest.approx(1)
    assert np.array_equal(np.flatnonzero(seen), left)
    # Each as often as any other: within six standard deviations of the rarest draw
    noise = np.sqrt(max(weights) / count / len(left) / batch)
    assert np.abs(seen[left] - 1 / len(left)).max() < 6 * noise


@pytest.mark.parametrize("background", ["hidden", "visible"])
def test_crops_are_of_own_views_each_as_likely_as_any_other(dataset, background):
    made = dataset(background)
    whole, times = source(Photographs.load(made, False), made), np.zeros(5)
    for photographs in loaded(made, 2):
        own = source(photographs, made)
        weight, draws = own.weight(crops=True), 400
        for seed in range(draws):
            numbers, colours = own.draw_crop(seed, 16).read()
            np.testing.assert_array_equal(colours, whole.photographs.table[numbers])
            (view,) = np.unique(whole.views_of(numbers))
            times[view] += weight / 2 / draws
    expected = np.full(5, 1 / 5) if background == "visible" else np.array([1, 1, 0, 1, 1]) / 4
    assert np.abs(times - expected).max() < 0.08
    assert times[2] == 0 or background == "visible"


def test_a_process_whose_views_show_nothing_has_no_weight(dataset):
    made = dataset()
    photographs = loaded(made, 5)[2]
    own = source(photographs, made)
    assert not len(photographs.places) and own.weight(crops=False) == 0
    for crops in (False, True):
        numbers, _ = (own.draw_crop if crops else own.draw)(1, 16).read()
        assert own.weight(crops=crops) == 0 and set(numbers.tolist()) <= set(photographs.pixels)


def test_one_process_holds_all_and_weighs_one(dataset):
    made = dataset()
    (alone,) = loaded(made, 1)
    assert alone.share is None and source(alone, made).weight(crops=True) == 1
