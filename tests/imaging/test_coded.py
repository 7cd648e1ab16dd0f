"""Images of code values: decoded as they were encoded, and damaged ones refused in one line."""

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from unbake.errors import UserError
from unbake.imaging.coded import decode, encode, read_codes, read_picture
from unbake.imaging.headers import CODED_SUFFIXES, HeaderError, ImageHeader, read_header
from unbake.imaging.pictures import tonemap

CODES = np.random.default_rng(3).integers(0, 256, (5, 7, 3)).astype(np.uint8)


def save(file, codes, **options):
    Image.fromarray(codes).save(file, **options)
    return file


@pytest.mark.parametrize("suffix", CODED_SUFFIXES)
def test_eight_bits_are_read(tmp_path, suffix):
    options = {"quality": 100, "subsampling": 0} if "jp" in suffix else {}
    file = save(tmp_path / f"a{suffix}", CODES, **options)
    assert read_header(file) == ImageHeader(7, 5, 3, 8)
    assert np.abs(read_codes(file).astype(int) - CODES).max() <= (4 if options else 0)


@pytest.mark.parametrize("subsampling", ["4:2:2", "4:2:0"])
@pytest.mark.parametrize("size", [(32, 48), (31, 47)])
def test_colour_of_jpeg_has_the_edges_of_brightness(tmp_path, subsampling, size):
    """Of coloured squares in more and less light, whose edges lie within blocks of colour."""
    y, x = np.mgrid[: size[0], : size[1]]
    light = 1 - 0.8 * (((y + 1) // 7 + (x + 1) // 5) % 2)
    linear = np.array((0.7, 0.2, 0.1)) * light[..., None]
    codes = tonemap(linear.astype(np.float32))
    file = save(tmp_path / "a.jpg", codes, quality=100, subsampling=subsampling)
    with Image.open(file) as image:
        smooth = np.array(image)
    errors = [np.abs(found.astype(int) - codes).mean() for found in (read_codes(file), smooth)]
    assert errors[0] < 0.6 * errors[1]


@pytest.mark.parametrize("subsampling", ["4:2:2", "4:2:0"])
def test_colour_jumps_where_surfaces_of_other_colours_meet(tmp_path, subsampling):
    """Where brightness tells two surfaces apart, each has its own colour up to the edge."""
    y, x = np.mgrid[:48, :64]
    dark = (((y + 1) // 7 + (x + 1) // 9) % 2).astype(bool)
    codes = np.where(dark[..., None], (120, 40, 30), (150, 190, 220)).astype(np.uint8)
    file = save(tmp_path / "a.jpg", codes, quality=100, subsampling=subsampling)
    with Image.open(file) as image:
        smooth = np.array(image)
    errors = [np.abs(found.astype(int) - codes).mean() for found in (read_codes(file), smooth)]
    assert errors[0] < 0.5 * errors[1]


def test_colour_that_brightness_says_nothing_of_keeps_its_means(tmp_path):
    rng, grey = np.random.default_rng(0), np.full((64, 64, 1), 128.0)
    colour = rng.uniform(-40, 40, (32, 32, 2)).repeat(2, 0).repeat(2, 1)
    ycc = np.round(np.concatenate([grey, 128 + colour], 2)).astype(np.uint8)
    Image.fromarray(ycc, "YCbCr").save(tmp_path / "a.jpg", quality=100, subsampling="4:2:0")
    found = Image.fromarray(read_codes(tmp_path / "a.jpg")).convert("YCbCr")
    means = [np.asarray(x, float).reshape(32, 2, 32, 2, 3).mean((1, 3)) for x in (found, ycc)]
    with Image.open(tmp_path / "a.jpg") as image:
        smooth = np.asarray(image.convert("YCbCr"), float).reshape(32, 2, 32, 2, 3).mean((1, 3))
    errors = [np.abs(x - means[1])[..., 1:].mean() for x in (means[0], smooth)]
    assert errors[0] < 0.6 * errors[1]


def test_colour_is_as_sharp_where_other_pictures_follow_in_the_file(tmp_path):
    """As phones and cameras of two lenses write them: Pillow calls these MPO."""
    codes = np.random.default_rng(0).integers(0, 256, (24, 20, 3)).astype(np.uint8)
    options = {"quality": 95, "subsampling": "4:2:0"}
    alone = save(tmp_path / "a.jpg", codes, **options)
    others = {"format": "MPO", "save_all": True, "append_images": [Image.fromarray(codes[::-1])]}
    several = save(tmp_path / "b.jpg", codes, **options, **others)
    with Image.open(several) as image:
        assert image.format == "MPO"
        smooth = np.array(image)
    assert np.array_equal(read_codes(several), read_codes(alone))
    assert not np.array_equal(read_codes(several), smooth)


@pytest.mark.parametrize(
    ("mode", "options"), [("RGB", {"subsampling": "4:4:4"}), ("L", {}), ("RGB", {"keep_rgb": True})]
)
def test_other_jpeg_files_are_as_pillow_reads_them(tmp_path, mode, options):
    file = tmp_path / "a.jpg"
    Image.fromarray(CODES).convert(mode).save(file, **options)
    with Image.open(file) as image:
        assert np.array_equal(read_codes(file), np.array(image.convert("RGB")))


@pytest.mark.parametrize(("mode", "channels"), [("L", 3), ("LA", 4), ("P", 3), ("RGBA", 4)])
def test_grey_palettes_and_alpha_are_read(tmp_path, mode, channels):
    image = Image.fromarray(CODES).convert(mode)
    image.save(tmp_path / "a.png")
    codes = read_codes(tmp_path / "a.png")
    assert np.array_equal(codes, np.array(image.convert("RGBA" if channels == 4 else "RGB")))


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_sixteen_bits_of_png_are_read_whole(tmp_path, channels):
    codes = np.random.default_rng(1).integers(0, 65536, (5, 7, channels)).astype(np.uint16)
    mi.Bitmap(codes).write(str(tmp_path / "a.png"))
    assert read_header(tmp_path / "a.png") == ImageHeader(7, 5, channels, 16)
    assert np.array_equal(read_codes(tmp_path / "a.png"), codes)


@pytest.mark.parametrize("compression", [None, "zlib"])
def test_sixteen_bits_of_tiff_are_read_whole(tmp_path, compression):
    tifffile = pytest.importorskip("tifffile", reason="16 bits of TIFF need tifffile")
    codes = np.random.default_rng(1).integers(0, 65536, (5, 7, 3)).astype(np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", codes, photometric="rgb", compression=compression)
    assert read_header(tmp_path / "a.tif") == ImageHeader(7, 5, 3, 16)
    assert np.array_equal(read_codes(tmp_path / "a.tif"), codes)


def test_decoding_is_the_inverse_of_tone_mapping():
    every = np.arange(256, dtype=np.uint8).reshape(16, 16, 1).repeat(3, 2)
    linear = decode(every)
    assert np.array_equal(tonemap(linear[..., :3]), every)
    fine = np.arange(65536, dtype=np.uint16).reshape(256, 256, 1)
    assert np.array_equal(encode(decode(fine)[..., :1]), fine)


@pytest.mark.parametrize("planes", ["contig", "separate"])
@pytest.mark.parametrize(
    "kind", ["plain", "white is zero", "unspecified", "unassalpha", "assocalpha"]
)
def test_what_samples_of_sixteen_bits_of_tiff_are_is_looked_up(kind, planes, tmp_path):
    tifffile = pytest.importorskip("tifffile", reason="16 bits of TIFF need tifffile")
    rng, file = np.random.default_rng(1), tmp_path / "a.tif"
    codes = rng.integers(0, 1 << 16, (5, 7, 3), np.uint16)
    if kind in ("plain", "white is zero"):
        grey = codes[..., 0]
        name = "minisblack" if kind == "plain" else "miniswhite"
        tifffile.imwrite(file, grey, photometric=name)
        expected = grey if kind == "plain" else 65535 - grey
        assert np.array_equal(read_codes(file)[..., 0], expected)
        return
    fourth = rng.integers(20000, 1 << 16, (5, 7, 1), np.uint16)
    written = codes
    if kind == "assocalpha":
        written = np.round(codes * (fourth / 65535)).astype(np.uint16)
    every = np.concatenate([written, fourth], -1)
    every = every if planes == "contig" else np.moveaxis(every, 2, 0)
    tifffile.imwrite(file, every, photometric="rgb", planarconfig=planes, extrasamples=[kind])
    found = read_codes(file)
    if kind == "unspecified":
        assert np.array_equal(found, codes)
    else:
        np.testing.assert_allclose(found[..., :3].astype(float), codes, atol=4)
        assert np.array_equal(found[..., 3:], fourth)


def test_inks_of_sixteen_bits_of_tiff_are_refused(tmp_path):
    tifffile = pytest.importorskip("tifffile", reason="16 bits of TIFF need tifffile")
    inks = np.zeros((5, 7, 4), np.uint16)
    tifffile.imwrite(tmp_path / "a.tif", inks, photometric="separated")
    with pytest.raises(UserError, match=r"are SEPARATED, not RGB or grey\). Convert it to RGB"):
        read_codes(tmp_path / "a.tif")


@pytest.mark.parametrize("suffix", [".jpg", ".tif", ".png"])
@pytest.mark.parametrize("orientation", [3, 6])
def test_pictures_are_not_turned_by_their_exif(suffix, orientation, tmp_path):
    exif = Image.Exif()
    exif[0x0112] = orientation
    file = save(tmp_path / f"a{suffix}", CODES, exif=exif)
    plain = save(tmp_path / f"b{suffix}", CODES)
    assert np.array_equal(read_picture(file), read_picture(plain))
    assert read_picture(file).shape == (5, 7, 4)


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif"])
def test_what_is_cut_off_is_refused_in_one_line(tmp_path, suffix):
    whole = save(tmp_path / f"whole{suffix}", CODES).read_bytes()
    file = tmp_path / f"a{suffix}"
    for length in (0, 3, 20, 40, 80, len(whole) // 2):
        file.write_bytes(whole[:length])
        with pytest.raises(UserError, match="the image cannot be read") as caught:
            read_codes(file)
        assert "\n" not in str(caught.value) and caught.value.remedy


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif"])
def test_a_header_that_claims_gigapixels_is_refused(tmp_path, suffix):
    file = save(tmp_path / f"a{suffix}", CODES)
    data = bytearray(file.read_bytes())
    if suffix == ".png":
        data[16:24] = b"\0\0\xff\xff" * 2
    elif suffix == ".jpg":
        at = data.index(b"\xff\xc0")
        data[at + 5 : at + 9] = b"\xff\xff\xff\xff"
    else:
        at = data.index((256).to_bytes(2, "little") + b"\4\0")
        data[at + 8 : at + 12] = (1 << 30).to_bytes(4, "little")
    file.write_bytes(data)
    with pytest.raises(HeaderError, match="bytes cannot hold"):
        read_header(file)


def test_other_colours_and_values_are_refused(tmp_path):
    Image.fromarray(CODES).convert("CMYK").save(tmp_path / "a.jpg")
    with pytest.raises(UserError, match="its colours are CMYK"):
        read_codes(tmp_path / "a.jpg")
    Image.fromarray(CODES[..., 0].astype(np.float32)).save(tmp_path / "a.tif")
    with pytest.raises(UserError, match="its values are no code values"):
        read_codes(tmp_path / "a.tif")
