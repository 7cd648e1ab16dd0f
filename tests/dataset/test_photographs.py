"""Photographs: the same in memory and in a mapped file, which is made once and never stale."""

import errno
import json
import mmap
import os
import shutil
import time
import tracemalloc
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from unbake import memory
from unbake.dataset import decoded_file, decoding
from unbake.dataset import photographs as module
from unbake.dataset.camera import Camera
from unbake.dataset.decoding import PEAK
from unbake.dataset.hot_pixels import told_hot_pixels, without_hot_pixels
from unbake.dataset.image_files import PIXEL_BYTES
from unbake.dataset.photographs import Photographs
from unbake.dataset.pixels import CameraRays, PixelSource
from unbake.dataset.views import Dataset, SensorNoise, View
from unbake.errors import UserError
from unbake.progress import EVERY
from unbake.transport.loss import RelativeL2

WIDTH, HEIGHT = 7, 5


@pytest.fixture
def dataset(tmp_path):
    """Three training views and a held-out one; a third of the pixels are background."""

    def make(background="hidden"):
        rng = np.random.default_rng(4)
        camera = Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 40, WIDTH, HEIGHT)
        views = []
        for i in range(4):
            rgba = rng.uniform(0, 2, (HEIGHT, WIDTH, 4)).astype(np.float32)
            rgba[..., 3] = rng.random((HEIGHT, WIDTH)) > 1 / 3
            image = tmp_path / f"{i}.exr"
            mi.Bitmap(rgba).write(str(image))
            split = "heldout" if i == 3 else "train"
            views.append(View(f"{i}", split, camera, image, {}))
        return Dataset(tmp_path, tmp_path / "s.xml", background, views, {}, None)

    return make


@pytest.fixture
def on_disk(monkeypatch):
    """Every data set is too large for memory."""
    monkeypatch.setattr(module, "IN_MEMORY", 0)


def leave_for_a_view(dataset, monkeypatch):
    """Leave the memory that decoding a view takes, but none for the table of all."""
    pixels = WIDTH * HEIGHT
    monkeypatch.setattr(memory, "free_bytes", lambda: (PIXEL_BYTES + 8) * pixels)


def rgba(dataset):
    return np.concatenate([np.array(mi.Bitmap(str(v.image))).reshape(-1, 4) for v in dataset.train])


@pytest.mark.parametrize("background", ["hidden", "visible"])
@pytest.mark.parametrize("where", ["memory", "disk"])
def test_pixels_are_those_of_the_images(dataset, background, where, monkeypatch):
    if where == "disk":
        monkeypatch.setattr(module, "IN_MEMORY", 0)
    made = dataset(background)
    found, truth = Photographs.load(made, False, smoothed=True), rgba(made)
    assert isinstance(found.table, np.memmap) == (where == "disk")
    assert (found.bytes == 0) == (where == "disk")
    np.testing.assert_array_equal(found.table[:, :3], truth[:, :3])
    counted = truth[:, 3] > 0 if background == "hidden" else np.ones(len(truth), bool)
    assert found.count == counted.sum()
    if background == "hidden":
        np.testing.assert_array_equal(found.chosen, np.flatnonzero(counted))
    assert found.mean == pytest.approx(truth[counted, :3].mean(), rel=1e-5)
    # What errors are relative to, in the middle and in a corner
    first = truth[: WIDTH * HEIGHT, :3].reshape(HEIGHT, WIDTH, 3)
    mask = counted[: WIDTH * HEIGHT].reshape(HEIGHT, WIDTH)
    for y, x in ((2, 3), (0, 0)):
        if mask[y, x]:
            expected = reference_at(first, mask, y, x)
            np.testing.assert_allclose(found.table[y * WIDTH + x, 3:], expected, rtol=1e-4)


def reference_at(image, counted, y, x):
    """The same as of the loader, pixel by pixel."""
    window = list(np.ndindex(HEIGHT, WIDTH))

    def far(p, row, column):
        return max(abs(p[0] - row), abs(p[1] - column))

    def others(row, column):
        near = [p for p in window if 0 < far(p, row, column) <= 2 and counted[p]]
        return np.mean([image[p] for p in near], 0)

    def around(row, column):  # edges are repeated
        rows = np.clip((row - 1, row, row + 1), 0, HEIGHT - 1)
        columns = np.clip((column - 1, column, column + 1), 0, WIDTH - 1)
        return [(i, j) for i in rows for j in columns]

    def response(row, column):
        signs = np.outer((1, -2, 1), (1, -2, 1)).ravel()
        return sum(s * known[p] for s, p in zip(signs, around(row, column), strict=True)) / 6

    known = image.copy()
    for p in window:
        if not counted[p] and any(0 < far(q, *p) <= 2 and counted[q] for q in window):
            known[p] = others(*p)
    blind = [p for p in window if far(p, y, x) == 2 and all(counted[q] for q in around(*p))]
    noise = np.mean([response(*p) ** 2 for p in blind], 0) if blind else np.zeros(3)
    second = np.sort([known[p] for p in around(y, x)], 0)[-2]
    peak = np.maximum(image[y, x] - second - PEAK * np.sqrt(noise), 0)
    return np.sqrt(others(y, x) ** 2 + noise + peak**2)


def test_batches_are_the_same_from_memory_and_from_a_file(dataset, monkeypatch):
    made = dataset()
    rays = CameraRays.of([v.camera for v in made.train])
    sampler = mi.load_dict({"type": "independent"})

    def drawn():
        sampler.seed(0, 64)
        batch = PixelSource(rays, Photographs.load(made, False, smoothed=True))
        batch = batch.draw(3, 32).batch(rays, sampler, 2)
        return [np.array(x) for x in (batch.target, batch.smoothed, batch.ray.d)]

    in_memory = drawn()
    monkeypatch.setattr(module, "IN_MEMORY", 0)
    for a, b in zip(in_memory, drawn(), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("where", ["memory", "disk"])
def test_a_blurred_copy_is_made_only_where_it_is_asked_for(dataset, where, monkeypatch):
    if where == "disk":
        monkeypatch.setattr(module, "IN_MEMORY", 0)
    made = dataset()
    rays = CameraRays.of([v.camera for v in made.train])
    sampler = mi.load_dict({"type": "independent"})

    def drawn(found):
        sampler.seed(0, 64)
        batch = PixelSource(rays, found).draw(3, 32).batch(rays, sampler, 2)
        return batch, [np.array(x) for x in (batch.target, batch.ray.d)]

    plain = Photographs.load(made, False, smoothed=False)
    batch, values = drawn(plain)
    assert plain.table.shape[1] == 3 and batch.smoothed is None and not plain.smoothed
    both = Photographs.load(made, False, smoothed=True)
    assert both.table.shape[1] == 6 and both.smoothed
    assert both.bytes - plain.bytes == (plain.table.nbytes if where == "memory" else 0)
    batch, others = drawn(both)
    assert batch.smoothed is not None
    for a, b in zip(values, others, strict=True):
        np.testing.assert_array_equal(a, b)


def one_view(rgb, alpha, *, foreground_only):
    height, width = alpha.shape
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 40, width, height)
    rgb = np.repeat(np.asarray(rgb, np.float32).reshape(-1, 1), 3, 1)
    return Photographs.of([camera], rgb, alpha.ravel(), foreground_only=foreground_only)


def weights(found, epsilon=0.001):
    """What pixels weigh in the relative loss, and what they do relative to themselves."""
    own, smoothed = (mi.Color3f(np.ascontiguousarray(x.T)) for x in np.split(found.table, 2, 1))
    pair = RelativeL2(epsilon, smoothed).weight(own), RelativeL2(epsilon).weight(own)
    return [np.array(w)[0] for w in pair]


@pytest.mark.parametrize("lamp", [0.5, 1.9, 50.0, 5e6])
def test_a_lamp_in_view_does_not_decide_the_level(lamp):
    """It is as bright as ten times the median at most; black background tells no median."""
    image = np.random.default_rng(5).uniform(0.1, 0.3, (32, 32))
    image[:20] = 0
    image[31, :8] = 0
    rest = image.sum()
    image[31, :8] = lamp
    found = one_view(image, np.ones((32, 32)), foreground_only=False)
    most = 10 * np.median(image[image > 0])
    assert found.mean == pytest.approx((rest + 8 * lamp) / 1024, rel=1e-5)
    assert found.level == pytest.approx((rest + 8 * min(lamp, most)) / 1024, rel=1e-5)
    assert lamp > most or found.level == found.mean


def test_the_level_knows_the_mask():
    image, alpha = np.full((16, 16), 0.2), np.ones((16, 16))
    image[:, 8:], alpha[:, 8:] = 30, 0
    assert one_view(image, alpha, foreground_only=True).level == pytest.approx(0.2)
    assert one_view(np.zeros((4, 4)), np.ones((4, 4)), foreground_only=False).level == 0


def test_the_blur_stays_within_the_foreground():
    """Across the edge of a disc, and of a single pixel, it would mix in the black background."""
    y, x = np.mgrid[:16, :16]
    disc = (x - 8) ** 2 + (y - 8) ** 2 < 25
    disc[1, 1] = True
    found = one_view(np.where(disc, 3.0, 0.0), disc.astype(np.float32), foreground_only=True)
    np.testing.assert_allclose(found.table[disc.ravel(), 3:], 3, rtol=1e-6)
    smoothed, itself = weights(found)
    np.testing.assert_allclose(smoothed[disc.ravel()], itself[disc.ravel()], rtol=1e-5)
    # Where black pixels are trained on, too, they count.
    visible = one_view(np.where(disc, 3.0, 0.0), disc.astype(np.float32), foreground_only=False)
    assert visible.table.reshape(16, 16, 6)[8, 2, 3] > 0.5 and not disc[8, 2]


@pytest.mark.parametrize("foreground_only", [False, True])
def test_a_firefly_weighs_no_more_than_relative_to_itself(foreground_only):
    image, alpha = np.full((16, 16), 0.02), np.ones((16, 16), np.float32)
    image[5, 6] = 20.0
    smoothed, itself = weights(one_view(image, alpha, foreground_only=foreground_only))
    assert (smoothed / itself).max() <= 1.01  # of the others it knows the mean alone
    far = np.ones((16, 16), bool)
    far[2:9, 3:10] = False
    np.testing.assert_allclose(smoothed[far.ravel()], itself[far.ravel()], rtol=1e-5)


def test_without_noise_the_reference_is_the_mean_around():
    """Of a ramp, whose corners repeat its edges, no pixel is a peak."""
    y, x = np.mgrid[:12, :10].astype(np.float32)
    image = 1 + 0.2 * x + 0.1 * y
    found = one_view(image, np.ones((12, 10)), foreground_only=True).table.reshape(12, 10, 6)
    np.testing.assert_allclose(found[3:-3, 3:-3, 3], image[3:-3, 3:-3], rtol=1e-5)


@pytest.mark.parametrize("deviation", [0.1, 0.4])
def test_the_reference_knows_the_noise(deviation):
    rng = np.random.default_rng(2)
    image = (2 + rng.normal(0, deviation, (96, 96))).astype(np.float32)
    found = one_view(image, np.ones((96, 96)), foreground_only=True)
    noise = np.mean(found.table[:, 3] ** 2) - image.mean() ** 2
    # The mean of 24 pixels has a share of the noise.
    assert 1.0 < noise / deviation**2 < 1.1
    # The optimum of a constant under the loss: relative to the photograph itself it is too dark.
    ours, itself = (np.average(image.ravel(), weights=w) - 2 for w in weights(found))
    assert itself < -(deviation**2) / 2 and abs(ours) < 0.2 * abs(itself)


@pytest.mark.parametrize("tail", [1.5, 0.8])
def test_weights_do_not_follow_noise_with_a_heavy_tail(tail):
    """As of path tracers: a few pixels have most of the light. Their own noise told weights."""
    rng = np.random.default_rng(4)
    image = rng.gamma(tail, 1 / tail, (256, 256)).astype(np.float32)
    found = one_view(image, np.ones((256, 256)), foreground_only=True)
    ours, itself = (np.average(image.ravel(), weights=w) / image.mean() for w in weights(found))
    assert itself < 0.5 and abs(ours - 1) < 0.05


@pytest.mark.parametrize("where", ["memory", "disk"])
def test_noise_that_is_known_is_not_told_from_neighbours(dataset, where, monkeypatch):
    if where == "disk":
        monkeypatch.setattr(module, "IN_MEMORY", 0)
    made, exposure = dataset("visible"), 4.0
    told = Photographs.load(made, False, smoothed=True).table.copy()
    known = [replace(view, noise=SensorNoise(0.02, 0.05)) for view in made.views]
    found = Photographs.load(replace(made, views=known), False, smoothed=True).table.copy()
    np.testing.assert_array_equal(found[:, :3], told[:, :3])
    # The mean is that of the others, 24 or fewer; a peak exceeds the second by more than noise.
    image = told[: WIDTH * HEIGHT, :3].reshape(HEIGHT, WIDTH, 3)
    for y, x in ((0, 0), (1, 6), (2, 3)):
        near = image[max(y - 2, 0) : y + 3, max(x - 2, 0) : x + 3]
        mean = (near.sum((0, 1)) - image[y, x]) / (near[..., 0].size - 1)
        noise = 0.02 * mean + 0.05**2
        padded = np.pad(image, ((1, 1), (1, 1), (0, 0)), "edge")
        second = np.sort(padded[y : y + 3, x : x + 3].reshape(9, 3), 0)[-2]
        peak = np.maximum(image[y, x] - second - PEAK * np.sqrt(noise), 0)
        expected, at = np.sqrt(mean**2 + noise + peak**2), y * WIDTH + x
        np.testing.assert_allclose(found[at, 3:], expected, rtol=1e-5)
    # Of values that are divided by the exposure.
    exposed = [replace(view, exposure=exposure) for view in known]
    divided = Photographs.load(replace(made, views=exposed), False, smoothed=True).table
    np.testing.assert_allclose(divided[at, 3:], expected / exposure, rtol=1e-5)


@pytest.mark.parametrize("light", [0.02, 0.05, 0.2])
def test_weights_do_not_follow_noise_that_is_known(tmp_path, light):
    """However dark a surface is, the optimum of a constant is right to a few percent."""
    noise, side = SensorNoise(0.005, 0.02), 128
    rng = np.random.default_rng(3)
    deviation = np.sqrt(noise.shot * light + noise.read**2)
    rgba = np.ones((side, side, 4), np.float32)
    rgba[..., :3] = np.maximum(light + rng.normal(0, deviation, (side, side, 3)), 0)
    mi.Bitmap(rgba).write(str(tmp_path / "0.exr"))
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 40, side, side)
    ends = []
    for told in (noise, None):
        view = View("0", "train", camera, tmp_path / "0.exr", {}, noise=told)
        data = Dataset(tmp_path, tmp_path / "s.xml", "visible", [view], {}, None)
        table = Photographs.load(data, False, smoothed=True).table
        ends.append(np.average(table[:, :3], weights=1 / (table[:, 3:] ** 2 + 1e-6)))
    assert abs(ends[0] / light - 1) < 0.04
    # Untold noise as large as the light: what was clipped at black makes it brighter.
    assert abs(ends[1] / light - 1) < (0.3 if light < 0.05 else 0.04)


def test_a_file_without_the_blurred_copy_is_made_anew_and_one_with_it_serves_both(
    dataset, on_disk, monkeypatch
):
    made, read = dataset(), []
    decode = decoding.read_masked
    monkeypatch.setattr(decoding, "read_masked", lambda *a: read.append(a) or decode(*a))
    decoded = []
    for smoothed in (False, False, True, True, False):
        found = Photographs.load(made, False, smoothed=smoothed)
        np.testing.assert_array_equal(found.table[:, :3], rgba(made)[:, :3])
        assert found.smoothed == smoothed
        assert found.bytes == 0
        decoded.append(len(read) // len(made.train))
    assert decoded == [1, 1, 2, 2, 2]


def test_images_are_decoded_once(dataset, on_disk, monkeypatch):
    made = dataset()
    first = Photographs.load(made, False)

    def never(*arguments):
        raise AssertionError("an image was read again")

    monkeypatch.setattr(decoding, "read_masked", never)
    again = Photographs.load(made, False)
    np.testing.assert_array_equal(first.table, again.table)
    assert again.mean == first.mean


@pytest.mark.parametrize("where", ["memory", "disk"])
def test_decoding_that_takes_long_tells_how_far_it_is(dataset, where, monkeypatch, clock):
    monkeypatch.setattr(module, "IN_MEMORY", 0 if where == "disk" else 1 << 30)
    monkeypatch.setattr(decoded_file, "_MUCH", 0)
    made, lines = dataset(), []
    clock.step = 2 * EVERY
    Photographs.load(made, False, tell=lines.append)
    if where == "disk":
        begin = f"decoding 3 photographs, once, into {made.folder}/.cache: "
        assert lines.pop(0).startswith(begin)
    assert lines == ["decoding photographs: 1 of 3", "decoding photographs: 2 of 3"]
    Photographs.load(made, False, tell=lines.append)
    assert len(lines) == (2 if where == "disk" else 4)  # the file is there


def test_decoding_that_is_over_soon_tells_nothing(dataset, on_disk, clock):
    lines = []
    Photographs.load(dataset(), False, tell=lines.append)
    assert lines == []


@pytest.mark.parametrize(
    "change",
    [
        "another image",
        "clipped",
        "interrupted",
        "damaged key",
        "odd key",
        "cut table",
        "spoilt table",
        "spoilt numbers",
        "pipe",
        "old blur",
    ],
)
def test_a_file_of_other_photographs_is_made_anew(dataset, on_disk, monkeypatch, change):
    made = dataset()
    Photographs.load(made, False)
    clip = change == "clipped"
    if change == "another image":
        image = made.train[1].image
        mi.Bitmap(np.full((HEIGHT, WIDTH, 4), 0.5, np.float32)).write(str(image))
        os.utime(image, ns=(1, 1))
    elif change == "interrupted":
        (made.folder / ".cache" / "key.json").unlink()
    elif change == "damaged key":
        (made.folder / ".cache" / "key.json").write_text("{")
    elif change == "odd key":
        (made.folder / ".cache" / "key.json").write_text("[]")
    elif change == "old blur":
        key = json.loads((made.folder / ".cache" / "key.json").read_text())
        del key["key"]["blur"]
        (made.folder / ".cache" / "key.json").write_text(json.dumps(key))
    elif change == "cut table":
        os.truncate(made.folder / ".cache" / "photographs.npy", 40)
    elif change == "spoilt table":
        table = np.lib.format.open_memmap(made.folder / ".cache" / "photographs.npy", "r+")
        table[3] = np.nan
        table.flush()
        os.utime(made.folder / ".cache" / "photographs.npy")
    elif change == "spoilt numbers":
        np.save(made.folder / ".cache" / "foreground.npy", np.full(70, 10**6, np.uint32))
    elif change == "pipe":
        (made.folder / ".cache" / "photographs.npy").unlink()
        os.mkfifo(made.folder / ".cache" / "photographs.npy")
    read = []
    decode = decoding.read_masked
    monkeypatch.setattr(decoding, "read_masked", lambda *a: read.append(a) or decode(*a))
    found = Photographs.load(made, clip)
    assert len(read) == len(made.train)
    np.testing.assert_array_equal(found.table[:, :3], rgba(made)[:, :3])


def test_a_bad_image_leaves_no_file_that_looks_whole(dataset, on_disk):
    made = dataset()
    made.train[2].image.write_bytes(b"no image")
    for _ in range(2):
        with pytest.raises(UserError, match=r"2\.exr"):
            Photographs.load(made, False)


def test_no_room_for_the_file_is_told_in_one_line(dataset, on_disk, monkeypatch):
    def full(*arguments, **named):
        raise OSError(28, "No space left on device")

    made = dataset()
    monkeypatch.setattr(os, "posix_fallocate", full)
    leave_for_a_view(made, monkeypatch)
    with pytest.raises(UserError, match=r"cannot be written .No space left") as caught:
        Photographs.load(made, False)
    assert "Make room" in caught.value.remedy
    assert not (made.folder / ".cache").exists()


def test_a_disk_that_is_too_small_is_told_with_both_numbers(dataset, on_disk, monkeypatch):
    made = dataset()
    usage = shutil.disk_usage(made.folder)
    monkeypatch.setattr(shutil, "disk_usage", lambda path: usage._replace(free=100))
    leave_for_a_view(made, monkeypatch)
    with pytest.raises(UserError, match=r"take 0\.0 GB, 0\.0 GB are free"):
        Photographs.load(made, False)
    assert not (made.folder / ".cache").exists()


@pytest.mark.parametrize("why", ["read-only", "full"])
def test_what_cannot_be_written_goes_to_memory_if_there_is_plenty(
    dataset, on_disk, monkeypatch, why
):
    """Data sets of a cluster or a container lie in folders that nobody writes to."""
    made = dataset()
    wanted = Photographs.load(made, False)
    shutil.rmtree(made.folder / ".cache")
    if why == "full":
        monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=100))
    else:

        def refuse(*arguments, **named):
            raise OSError(errno.EROFS, "Read-only file system")

        monkeypatch.setattr(decoded_file, "locked", refuse)
    found = Photographs.load(made, False)
    assert found.bytes and not (made.folder / ".cache").exists()
    for a, b in ((found.table, wanted.table), (found.chosen, wanted.chosen)):
        np.testing.assert_array_equal(a, b)
    assert found.mean == wanted.mean


def test_a_file_that_is_there_needs_no_memory(dataset, on_disk, monkeypatch):
    made = dataset()
    wanted = Photographs.load(made, False)
    monkeypatch.setattr(memory, "free_bytes", lambda: 100)
    monkeypatch.setattr(decoded_file, "free_bytes", lambda: 100)  # so that nothing is read ahead
    found = Photographs.load(made, False)
    np.testing.assert_array_equal(found.table, wanted.table)


def test_as_many_views_are_decoded_at_once_as_fit_beside_the_table(dataset, monkeypatch):
    count, pixels = 4 * len(dataset().train), WIDTH * HEIGHT
    most = partial(decoding.decoded_at_once, count, pixels, coded=True)
    monkeypatch.setattr(decoding, "usable_cores", lambda: 8)
    monkeypatch.setattr(decoding, "free_bytes", lambda: 10 * PIXEL_BYTES * pixels)
    assert most() == 5
    assert most(held=6 * PIXEL_BYTES * pixels) == 2
    assert most(processes=2) == 2
    assert most(held=20 * PIXEL_BYTES * pixels) == 1
    assert most(coded=False) == 1, "OpenEXR reads in threads of its own"


def test_of_a_file_that_memory_has_no_room_for_rows_alone_are_read(dataset, on_disk, monkeypatch):
    made = dataset()
    found, asked = Photographs.load(made, False), []

    class Mapped:
        def __len__(self):
            return 1000

        def madvise(self, advice):
            asked.append(advice)

    for free, wanted in ((10_000, []), (1500, [mmap.MADV_RANDOM])):
        monkeypatch.setattr(decoded_file, "free_bytes", lambda free=free: free)
        decoded_file.expect_random(SimpleNamespace(_mmap=Mapped()))
        assert asked == wanted
    found.expect_random()  # of a mapping that is one, and of arrays in memory
    replace(found, table=np.array(found.table), chosen=None).expect_random()


def test_another_writer_at_the_same_time_ends_no_fit(dataset, on_disk, monkeypatch):
    """Some file systems have no locks: files of these names may be another's by now."""
    made = dataset()
    wanted = Photographs.load(made, False)
    shutil.rmtree(made.folder / ".cache")
    plain = decoded_file.write_json

    def and_another(path, content, **more):
        plain(path, content | {"table": [0, 0]}, **more)

    monkeypatch.setattr(decoded_file, "write_json", and_another)
    found = Photographs.load(made, False)
    np.testing.assert_array_equal(found.table, wanted.table)
    np.testing.assert_array_equal(found.chosen, wanted.chosen)


def test_a_data_set_may_be_called_by_any_path(dataset, on_disk, monkeypatch):
    """What is decoded once serves fits in this folder and in others, and where it was moved."""
    made = dataset()
    Photographs.load(made, False)
    monkeypatch.setattr(decoding, "read_masked", None)
    for place, name in ((made.folder.parent, made.folder.name), (made.folder, ".")):
        monkeypatch.chdir(place)
        views = [replace(view, image=Path(name) / view.image.name) for view in made.views]
        Photographs.load(replace(made, folder=Path(name), views=views), False)
    moved = made.folder.rename(made.folder.with_name("moved"))
    views = [replace(view, image=moved / view.image.name) for view in made.views]
    Photographs.load(replace(made, folder=moved, views=views), False)


@pytest.mark.parametrize("kind", ["8 bits", "16 bits", "JPEG"])
def test_files_of_code_values_are_decoded_at_once(tmp_path, monkeypatch, kind):
    rng, views = np.random.default_rng(2), []
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 40, WIDTH, HEIGHT)
    for i in range(9):
        image = tmp_path / f"{i}.{'jpg' if kind == 'JPEG' else 'png'}"
        if kind == "16 bits":
            codes = rng.integers(0, 1 << 16, (HEIGHT, WIDTH, 4), dtype=np.uint16)
            mi.Bitmap(codes).write(str(image))
        else:
            channels = 3 if kind == "JPEG" else 4
            codes = rng.integers(0, 256, (HEIGHT, WIDTH, channels), dtype=np.uint8)
            Image.fromarray(codes).save(image)
        views.append(View(f"{i}", "train", camera, image, {}, encoding="srgb"))
    made = Dataset(tmp_path, tmp_path / "s.xml", "hidden", views, {}, None)
    at_once = []
    plain = decoding.in_order

    def counted(work, arguments, count):
        at_once.append(count)
        return plain(work, arguments, count)

    monkeypatch.setattr(decoding, "in_order", counted)
    monkeypatch.setattr(decoding, "usable_cores", lambda: 4)
    filters = list(warnings.filters)
    several = Photographs.load(made, False)
    # Filters and the limit are of the process, and threads come and go in any order.
    assert warnings.filters == filters and Image.MAX_IMAGE_PIXELS
    monkeypatch.setattr(decoding, "usable_cores", lambda: 1)
    alone = Photographs.load(made, False)
    assert at_once == [4, 1]
    for a, b in ((several.table, alone.table), (several.chosen, alone.chosen)):
        np.testing.assert_array_equal(a, b)
    assert several.mean == alone.mean


@pytest.mark.parametrize("noise", [None, SensorNoise(0.01, 0.02)])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(("height", "width"), [(300, 31), (65, 9), (1, 1), (3, 200)])
def test_bands_of_a_photograph_are_those_of_the_whole(height, width, masked, noise):
    rng = np.random.default_rng(3)
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 40, width, height)
    rgb = rng.random((height * width, 3), dtype=np.float32)
    counted = rng.random(height * width) > 0.3 * masked
    found = np.empty_like(rgb)
    decoding._put_reference(found, rgb, counted, camera, noise)
    weight = counted.astype(np.float32).reshape(height, width, 1)
    with np.errstate(invalid="ignore"):
        whole = decoding._reference(rgb.reshape(height, width, 3), weight, noise)
    np.testing.assert_array_equal(found, whole.reshape(-1, 3))


def test_decoding_takes_no_more_memory_than_it_asks_for(tmp_path):
    width, height = 800, 600
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 40, width, height)
    codes = np.random.default_rng(1).integers(0, 256, (height, width, 3), dtype=np.uint8)
    Image.fromarray(codes).save(tmp_path / "0.jpg", subsampling=2)
    Image.fromarray(codes[..., 0]).save(tmp_path / "mask.png")
    view = View("0", "train", camera, tmp_path / "0.jpg", {}, encoding="srgb", exposure=2.0)
    view = replace(view, mask=tmp_path / "mask.png", noise=SensorNoise(0.001, 0.01))
    made = Dataset(tmp_path, tmp_path / "s.xml", "visible", [view], {}, None)
    plan = decoding.Plan.of(made, False, 6, 1)
    table = np.empty((width * height, 6), np.float32)
    plan.decode_into(table, made.train)  # modules are imported
    tracemalloc.start()
    try:
        plan.decode_into(table, made.train)
        assert tracemalloc.get_traced_memory()[1] < PIXEL_BYTES * width * height
    finally:
        tracemalloc.stop()


def test_a_refused_image_leaves_nothing_behind(dataset, on_disk):
    made = dataset()
    made.train[2].image.write_bytes(b"no image")
    with pytest.raises(UserError):
        Photographs.load(made, False)
    assert not (made.folder / ".cache").exists()


def other_image(made):
    mi.Bitmap(np.full((HEIGHT, WIDTH, 4), 0.5, np.float32)).write(str(made.train[1].image))
    os.utime(made.train[1].image, ns=(1, 1))


def test_a_mask_that_moves_to_another_view_counts_there(dataset, on_disk):
    made = dataset("visible")
    mask = made.folder / "mask.png"
    Image.fromarray(np.zeros((HEIGHT, WIDTH), np.uint8)).save(mask)
    for number in (0, 1):
        views = [replace(v, mask=mask if v.name == str(number) else None) for v in made.views]
        found = Photographs.load(replace(made, views=tuple(views)), False)
        assert found.masked and found.count == 2 * WIDTH * HEIGHT
        view = found.chosen // (WIDTH * HEIGHT)
        assert set(view.tolist()) == {0, 1, 2} - {number}


def test_a_file_that_a_fit_has_mapped_stays_as_it_is(dataset, on_disk):
    """A second fit remade it in place: the first one read other pixels, or died by SIGBUS."""
    made = dataset()
    Photographs.load(made, False)
    first = Photographs.load(made, False)
    before = first.table.copy(), first.chosen.copy()
    other_image(made)
    second = Photographs.load(made, False)
    np.testing.assert_array_equal(first.table, before[0])
    np.testing.assert_array_equal(first.chosen, before[1])
    assert (second.table[WIDTH * HEIGHT, :3] == 0.5).all()


def test_two_fits_at_once_decode_once(dataset, on_disk, monkeypatch):
    made, read, decode = dataset(), [], decoding.read_masked

    def slowly(*arguments):
        read.append(arguments)
        time.sleep(0.1)
        return decode(*arguments)

    monkeypatch.setattr(decoding, "read_masked", slowly)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: Photographs.load(made, False), range(4)))
    assert len(read) == len(made.train)
    for one in found:
        np.testing.assert_array_equal(one.table, found[0].table)
    assert sorted(p.name for p in (made.folder / ".cache").iterdir()) == [
        "foreground.npy",
        "key.json",
        "photographs.npy",
    ]


def test_fits_of_other_settings_at_once_each_have_their_own(dataset, on_disk):
    made = dataset()
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda i: Photographs.load(made, bool(i % 2)), range(12)))
    for one in found:
        np.testing.assert_array_equal(one.table[:, :3], rgba(made)[:, :3])


def test_what_a_killed_fit_has_left_is_removed(dataset, on_disk):
    made = dataset()
    (made.folder / ".cache").mkdir()
    (made.folder / ".cache" / ".photographs.npy.0123456789abcdef.tmp").write_bytes(b"half")
    Photographs.load(made, False)
    assert not list((made.folder / ".cache").glob(".*"))


@pytest.mark.parametrize("name", ["photographs.npy", "foreground.npy", "key.json"])
def test_nothing_is_written_through_a_link_in_the_cache(dataset, on_disk, name):
    made = dataset()
    victim = made.folder / "victim"
    victim.write_text("mine")
    (made.folder / ".cache").mkdir()
    (made.folder / ".cache" / name).symlink_to(victim)
    found = Photographs.load(made, False)
    np.testing.assert_array_equal(found.table[:, :3], rgba(made)[:, :3])
    assert victim.read_text() == "mine" and not (made.folder / ".cache" / name).is_symlink()


def test_a_cache_that_is_a_link_is_refused(dataset, on_disk, tmp_path):
    made = dataset()
    (tmp_path / "elsewhere").mkdir()
    (made.folder / ".cache").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(UserError, match="cache: the cache is a link") as caught:
        Photographs.load(made, False)
    assert "--allow-outside" in caught.value.remedy
    assert not list((tmp_path / "elsewhere").iterdir())
    Photographs.load(replace(made, allow_outside=True), False)
    assert len(list((tmp_path / "elsewhere").iterdir())) == 3


def test_more_pixels_than_there_are_numbers_are_refused(dataset):
    made = dataset()
    huge = Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 40, 65_000, 65_000)
    views = [replace(view, camera=huge) for view in made.views]
    with pytest.raises(UserError, match=r"have 12,675,000,000 pixels, more than 4,294,967,295"):
        Photographs.load(replace(made, views=views), False)


def test_photographs_that_do_not_fit_the_memory_are_refused_before_they_are_read(
    dataset, monkeypatch
):
    made = dataset()
    monkeypatch.setattr(memory, "free_bytes", lambda: 4000)
    monkeypatch.setattr(decoding, "read_masked", None)
    with pytest.raises(UserError, match="the photographs need about 0 MB of memory, 0 MB are free"):
        Photographs.load(made, False)


# ----------------------------------------------------------------------------------- Hot pixels


@pytest.mark.parametrize("where", ["memory", "disk"])
def test_a_pixel_that_is_far_too_bright_is_told_and_made_as_dark_as_others(
    tmp_path, monkeypatch, where
):
    if where == "disk":
        monkeypatch.setattr(module, "IN_MEMORY", 0)
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 40, 20, 16)
    rng = np.random.default_rng(1)
    views = []
    for i in range(5):
        rgba = np.ones((16, 20, 4), np.float32)
        rgba[..., :3] = rng.uniform(0.1, 0.9, (16, 20, 3))
        if i != 3:
            rgba[7, 11, :3] = 1e8, 5e7, 0
        mi.Bitmap(rgba).write(str(tmp_path / f"{i}.exr"))
        views.append(View(f"{i}", "train", camera, tmp_path / f"{i}.exr", {}))
    made = Dataset(tmp_path, tmp_path / "s.xml", "visible", views, {}, None)
    for _ in range(2):  # decoded, and from the cache
        found = Photographs.load(made, False)
        pixel, limit = found.table[7 * 20 + 11], found.hot_pixels[0].limit
        assert 0.8 < limit < 0.9 and 0.4 < found.mean < 0.6
        np.testing.assert_allclose(pixel[:3], [limit, limit / 2, 0], rtol=1e-5)
        assert found.table[:, 3:].max() < 1
        assert [o.view for o in found.hot_pixels] == ["0", "1", "2", "4"]
        line = told_hot_pixels(found.hot_pixels)
        assert line.startswith(
            "4 pixels are over 100,000 times as bright as the others: "
            f"0 at (11, 7): 1e+08, taken as {limit:.3g}; 1 at (11, 7)"
        )
        assert line.endswith("; and 1 more")


def test_a_lamp_in_a_dark_room_is_no_hot_pixel():
    rng = np.random.default_rng(1)
    pixels = np.c_[rng.uniform(0.001, 0.01, (4096, 3)), np.ones(4096)].astype(np.float32)
    pixels[:3, :3] = 50
    kept, found = without_hot_pixels(pixels, np.ones(4096, bool), "a", 64)
    assert kept is pixels and found is None
    # Nor is the background that is not trained on, nor anything in a black photograph
    pixels[3, :3] = 1e9
    counted = np.arange(4096) != 3
    assert without_hot_pixels(pixels, counted, "a", 64)[1] is None
    pixels[4:, :3] = 0
    assert without_hot_pixels(pixels, np.ones(4096, bool), "a", 64)[1] is None


@pytest.mark.parametrize("edge", [5, 6], ids=["firefly", "bulb"])
def test_what_is_larger_than_a_spread_firefly_is_seen(edge):
    """A filter of 5 x 5 pixels spreads a firefly over as many; a bulb of 6 x 6 is as it is."""
    room = np.random.default_rng(1).uniform(0.02, 0.05, (256, 256, 4)).astype(np.float32)
    room[100 : 100 + edge, 253 - edge : 253, :3] = 2e4
    room[3, 4, :3] = 1e6  # by itself, and hot in both
    pixels = room.reshape(-1, 4)
    kept, found = without_hot_pixels(pixels, np.ones(256 * 256, bool), "a", 256)
    assert found.count == (26 if edge == 5 else 1)
    assert (kept[:, 0] == 2e4).sum() == (0 if edge == 5 else 36)
    assert (found.column, found.row) == (4, 3)


@pytest.mark.filterwarnings("error")
def test_a_limit_beyond_32_bits_is_none():
    """NumPy would warn of an overflow, with a line of our source."""
    pixels = np.full((4096, 4), 3e37, np.float32)
    assert without_hot_pixels(pixels, np.ones(4096, bool), "a", 64)[1] is None


def test_what_rings_in_jpeg_files_is_left_out_of_mapped_photographs_too(tmp_path, monkeypatch):
    codes = np.full((24, 24, 3), 40, np.uint8)
    codes[8:14, 8:14] = 255
    camera = Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), 40, 24, 24)
    views = []
    for name in ("a", "b"):
        Image.fromarray(codes).save(tmp_path / f"{name}.jpg", quality=80)
        file = tmp_path / f"{name}.jpg"
        views.append(View(name, "train", camera, file, {}, encoding="srgb", clipped=0.95))
    dataset = Dataset(tmp_path, tmp_path / "scene.xml", "visible", tuple(views), {}, None)
    whole = Photographs.load(dataset, clip_negative=False)
    assert whole.masked and 0 < whole.count < 2 * 24 * 24
    monkeypatch.setattr(module, "IN_MEMORY", 0)
    for _ in range(2):
        mapped = Photographs.load(dataset, clip_negative=False)
        np.testing.assert_array_equal(mapped.chosen, whole.chosen)
        assert mapped.count == whole.count and mapped.masked
    with monkeypatch.context() as patch:  # it is found again, and not made anew
        patch.setattr(decoded_file, "_write_cache", None)
        assert Photographs.load(dataset, clip_negative=False).count == whole.count
