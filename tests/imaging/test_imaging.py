"""PSNR and the pictures it is measured on."""

from __future__ import annotations

import base64
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from unbake.errors import UserError
from unbake.imaging import metrics, pictures
from unbake.io import write_atomically


def _picture(height: int = 9, width: int = 13, channels: int = 3) -> np.ndarray:
    return np.random.default_rng(1).uniform(0, 1, (height, width, channels)).astype(np.float32)


# --------------------------------------------------------------------------------------------- PSNR


def test_a_constant_error_has_the_psnr_of_the_formula():
    reference = _picture()
    assert metrics.psnr(reference + 0.1, reference) == pytest.approx(20.0, abs=1e-4)
    assert metrics.psnr(reference + 10, reference) == pytest.approx(-20.0, abs=1e-4)


def test_values_above_one_are_not_clamped():
    assert metrics.psnr(np.full((2, 2), 3.0), np.full((2, 2), 2.0)) == pytest.approx(0.0)


def test_equal_pictures_have_the_highest_number():
    assert metrics.psnr(_picture(), _picture()) == metrics.HIGHEST == 120
    assert metrics.psnr(_picture() + 1e-8, _picture()) == metrics.HIGHEST


def test_only_masked_pixels_count():
    reference, image = np.zeros((4, 4, 3)), np.full((4, 4, 3), np.nan)
    mask = np.zeros((4, 4), bool)
    mask[1, 2] = True
    image[1, 2] = 0.1
    assert metrics.psnr(image, reference, mask) == pytest.approx(20.0)


@pytest.mark.parametrize(
    ("image", "reference", "mask", "kind", "said"),
    [
        (np.zeros((4, 4, 3)), np.zeros((4, 5, 3)), None, ValueError, "cannot be compared"),
        (np.zeros(4), np.zeros(4), None, ValueError, "cannot be compared"),
        (np.zeros((4, 4)), np.ones((4, 4)), np.zeros((4, 4), bool), ValueError, "empty"),
        (np.zeros((4, 4)), np.ones((4, 4)), np.ones((4, 5), bool), ValueError, "does not fit"),
        (np.zeros((4, 4)), np.ones((4, 4)), np.ones((4, 4)), ValueError, "float64 mask"),
        (
            np.full((2, 2), np.nan),
            np.ones((2, 2)),
            None,
            UserError,
            "4 of 4 compared .* not finite",
        ),
        (np.full((2, 2), np.inf), np.full((2, 2), np.inf), None, UserError, "not finite"),
    ],
)
def test_what_cannot_be_compared_is_refused(image, reference, mask, kind, said):
    with pytest.raises(kind, match=said):
        metrics.psnr(image, reference, mask)


def test_the_mean_over_views_leaves_out_views_without_truth():
    assert metrics.mean_psnr([10.0, None, 20.0]) == 15.0
    assert metrics.mean_psnr([None]) is None
    assert metrics.mean_psnr([]) is None


# -------------------------------------------------------------------------------------------- files


@pytest.mark.parametrize(
    "error", [MemoryError("std::bad_alloc"), UnicodeDecodeError("utf-8", b"\xff", 0, 1, "invalid")]
)
def test_an_exr_that_mitsuba_cannot_take(error, tmp_path: Path, monkeypatch):
    """It claims more pixels than fit the memory, or Mitsuba's message is not UTF-8."""

    def fail(*words):
        raise error

    fail.FileFormat = mi.Bitmap.FileFormat
    path = tmp_path / "picture.exr"
    pictures.write_exr(path, np.ones((4, 4, 3)))
    monkeypatch.setattr(pictures.mi, "Bitmap", fail)
    with pytest.raises(UserError, match=r"picture\.exr: the picture cannot be read as OpenEXR"):
        pictures.read_exr(path)


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_exr_gives_back_what_was_written(tmp_path: Path, channels: int):
    picture = _picture(channels=channels) * 100 - 3
    path = tmp_path / "folder" / "picture.exr"
    pictures.write_exr(path, picture)
    again = pictures.read_exr(path)
    assert again.dtype == np.float32
    np.testing.assert_array_equal(again, picture)
    assert [p.name for p in path.parent.iterdir()] == ["picture.exr"]


def test_unreadable_pictures_are_named(tmp_path: Path):
    with pytest.raises(UserError, match=r"gone\.exr: the picture does not exist"):
        pictures.read_exr(tmp_path / "gone.exr")
    good, torn = tmp_path / "good.exr", tmp_path / "torn.exr"
    pictures.write_exr(good, _picture())
    torn.write_bytes(good.read_bytes()[:400])
    with pytest.raises(UserError, match=r"torn\.exr"):
        pictures.read_exr(torn)
    other = tmp_path / "other.exr"
    pictures.write_png(other, pictures.tonemap(_picture()))
    with pytest.raises(UserError, match=r"other\.exr.*OpenEXR"):
        pictures.read_exr(other)


def test_a_failed_write_leaves_the_old_file(tmp_path: Path):
    path = tmp_path / "page.html"
    path.write_text("old")

    def fail(temporary: Path) -> None:
        temporary.write_text("half")
        raise OSError("disk full")

    with pytest.raises(UserError, match="disk full"):
        write_atomically(path, fail)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_png_and_its_data_address_hold_the_same_pixels(tmp_path: Path):
    picture = pictures.tonemap(_picture())
    path = tmp_path / "picture.png"
    pictures.write_png(path, picture)
    np.testing.assert_array_equal(np.array(mi.Bitmap(str(path))), picture)
    prefix, _, data = pictures.png_data_uri(picture).partition(",")
    assert prefix == "data:image/png;base64"
    assert base64.b64decode(data) == path.read_bytes()


def test_float_arrays_are_no_png(tmp_path: Path):
    with pytest.raises(ValueError, match="8-bit"):
        pictures.write_png(tmp_path / "p.png", _picture())
    with pytest.raises(ValueError, match="not a picture"):
        pictures.write_exr(tmp_path / "p.exr", np.zeros((3, 3, 2)))


# ------------------------------------------------------------------------------------------- colour


def test_tonemap_follows_the_srgb_curve():
    linear = np.array([[[0.0, 0.0031308, 0.2140411]], [[1.0, 7.0, -1.0]]])
    np.testing.assert_array_equal(
        pictures.tonemap(linear), [[[0, 10, 127]], [[255, 255, 0]]]
    )  # 0.2140411 is the linear value of sRGB 0.5, up to rounding
    np.testing.assert_array_equal(pictures.tonemap(linear / 4, 2.0), pictures.tonemap(linear))
    odd = np.array([[[np.nan, np.inf, -np.inf]]])
    np.testing.assert_array_equal(pictures.tonemap(odd), [[[0, 255, 0]]])


def error_picture(image, reference, scale, mask=None):
    return pictures.false_colour(pictures.absolute_error(image, reference), scale, mask)


def test_the_error_picture_gets_brighter_with_the_error():
    reference = np.zeros((1, 64, 3), np.float32)
    image = np.linspace(0, 1, 64, dtype=np.float32)[None, :, None].repeat(3, axis=2)
    painted = error_picture(image, reference, 1.0)
    assert painted.dtype == np.uint8
    luminance = painted[0] @ np.array([0.2126, 0.7152, 0.0722])
    assert (np.diff(luminance) >= -0.5).all()
    np.testing.assert_array_equal(painted[0, 0], pictures.MAGMA[0])
    np.testing.assert_array_equal(painted[0, -1], pictures.MAGMA[-1])


def test_the_error_picture_marks_mask_and_broken_pixels():
    image = np.zeros((1, 3, 3), np.float32)
    image[0, 1] = np.nan
    mask = np.array([[True, True, False]])
    painted = error_picture(image, np.zeros_like(image), 1.0, mask)
    assert [tuple(p) for p in painted[0]] == [
        pictures.MAGMA[0],
        pictures.NOT_FINITE,
        pictures.OUTSIDE_MASK,
    ]
    with pytest.raises(ValueError, match="positive"):
        error_picture(image, image, 0.0)
    with pytest.raises(ValueError, match="cannot be compared"):
        error_picture(image, image[:, :2], 1.0)


def test_shrink_averages_blocks():
    picture = np.arange(6 * 4, dtype=np.float64).reshape(6, 4)
    assert pictures.shrink(picture, 6) is picture
    small = pictures.shrink(picture, 3)
    assert small.shape == (3, 2)
    assert small[0, 0] == picture[:2, :2].mean()
    assert pictures.shrink(np.zeros((7, 5, 3)), 3).shape == (2, 1, 3)


def test_montage_keeps_every_pixel_in_place():
    red = np.full((4, 6, 3), (255, 0, 0), np.uint8)
    blue = np.full((2, 3, 3), (0, 0, 255), np.uint8)
    sheet = pictures.montage([[red, blue], [blue]], gap=1, paper=9)
    assert sheet.shape == (1 + 4 + 1 + 2 + 1, 1 + 6 + 1 + 3 + 1, 3)
    assert (sheet[1:5, 1:7] == red).all()
    assert (sheet[1:3, 8:11] == blue).all()
    assert (sheet[6:8, 1:4] == blue).all()
    assert (sheet == 9).all(axis=2).sum() == sheet.shape[0] * sheet.shape[1] - 24 - 6 - 6
    with pytest.raises(ValueError, match="at least one"):
        pictures.montage([])
    with pytest.raises(ValueError, match="8-bit"):
        pictures.montage([[np.zeros((2, 2, 3))]])
