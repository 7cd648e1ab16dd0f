"""Camera RAW: a DNG file written here comes back as the light that it was made of."""

import struct

import numpy as np
import pytest
import tifffile
from layouts import APERTURE, ISO, SECONDS, quiet, write_json
from PIL import Image

from unbake.dataset.views import Dataset, read_masked, read_photograph
from unbake.errors import UserError
from unbake.importing.faults import ImportFaults
from unbake.importing.import_data import import_data
from unbake.importing.raw import CLIPPED, raw_balances, raw_told, read_raw
from unbake.importing.settings import ImportSettings

pytest.importorskip("rawpy", reason="camera RAW needs rawpy")

BLACK, WHITE, SIZE = 256, 16383, 32
#: What the sensor counts of white light, of its largest count.
NEUTRAL = (0.5, 1.0, 0.625)
#: tifffile writes no EXIF: a private tag becomes the one of its directory.
PRIVATE, EXIF_DIRECTORY, RATIONAL, SHORT, LONG = 65000, 34665, 5, 3, 4
#: Of XYZ to the colours of a sensor that sees some green in all that is blue, and white as grey.
SEES = ((0.9, -0.3, -0.1), (-0.5, 1.3, 0.2), (-0.1, 0.4, 0.6))
#: The same of another sensor, whose red is weaker and whose blue is stronger.
SEES_LESS_RED = ((0.6, -0.1, -0.1), (-0.4, 1.2, 0.2), (-0.1, 0.2, 0.9))
#: Linear sRGB to XYZ (IEC 61966-2-1).
TO_XYZ = ((0.4124, 0.3576, 0.1805), (0.2126, 0.7152, 0.0722), (0.0193, 0.1192, 0.9505))


def write_dng(file, light, iso=None, chosen=NEUTRAL, sees=None):
    """Light (H, W, 3) in [0, 1] behind a Bayer mosaic, with 1/100 s and f/2 if an ISO is given.

    `chosen` is what the camera took for white light, and `sees` how it sees XYZ.
    """
    sensor = np.minimum(light * NEUTRAL, 1)
    y, x = np.mgrid[: light.shape[0], : light.shape[1]]
    channel = y % 2 + x % 2
    counts = BLACK + (WHITE - BLACK) * np.take_along_axis(sensor, channel[..., None], 2)[..., 0]
    parts = [value for share in chosen for value in (round(1000 * share), 1000)]
    tags = [
        (50706, "B", 4, (1, 4, 0, 0), True),  # version
        (50708, "s", 0, "unbake", True),
        (33421, "H", 2, (2, 2), True),  # the mosaic: red, green, green, blue
        (33422, "B", 4, (0, 1, 1, 2), True),
        (50714, "H", 1, BLACK, True),
        (50717, "I", 1, WHITE, True),
        (50728, "2I", 3, tuple(parts), True),
        (PRIVATE, "I", 1, 0, True),
    ]
    if sees:
        entries = [part for row in sees for x in row for part in (round(1000 * x), 1000)]
        tags += [(50721, "2i", 9, tuple(entries), True), (50778, "H", 1, 21, True)]
    options = {"photometric": 32803, "metadata": None, "software": False}
    file.parent.mkdir(parents=True, exist_ok=True)
    tifffile.imwrite(file, np.round(counts).astype(np.uint16), extratags=tags, **options)
    data = bytearray(file.read_bytes())
    assert data[:2] == b"II"
    place = data.index(struct.pack("<HHI", PRIVATE, LONG, 1))
    start, entries = len(data), 3 if iso else 0
    data[place : place + 12] = struct.pack("<HHII", EXIF_DIRECTORY, LONG, 1, start)
    behind = start + 2 + 12 * entries + 4
    data += struct.pack("<H", entries)
    if iso:
        data += struct.pack("<HHII", SECONDS, RATIONAL, 1, behind)
        data += struct.pack("<HHII", APERTURE, RATIONAL, 1, behind + 8)
        data += struct.pack("<HHIHH", ISO, SHORT, 1, iso, 0)
    data += struct.pack("<I4I", 0, 1, 100, 2, 1)
    file.write_bytes(data)


def grey(*colour):
    return np.broadcast_to(np.array(colour, float), (SIZE, SIZE, 3))


@pytest.fixture
def project(captured, tmp_path):
    """Cameras of photographs that are not there, and camera RAW of the same names."""
    camera, frames = captured.views[0].camera, []
    for number, view in enumerate(captured.views):
        pose = view.camera.to_world.tolist()
        frames.append({"file_path": f"jpg/{number}.jpg", "transform_matrix": pose})
        write_dng(tmp_path / "nerf" / "jpg" / f"{number}.DNG", grey(0.4, 0.2, 0.1), 100 << number)
    focal = camera.fl_x * SIZE / camera.width
    lens = {"fl_x": focal, "fl_y": focal, "w": SIZE, "h": SIZE}
    write_json(tmp_path / "nerf" / "transforms.json", lens | {"frames": frames})
    return tmp_path / "nerf"


def test_light_comes_back(tmp_path):
    light = grey(0.4, 0.2, 0.1).copy()
    light[:, 16:] = 0.8
    write_dng(tmp_path / "a.dng", light)
    balance, _ = raw_balances(tmp_path / "a.dng")
    assert np.array(balance[:3]) * NEUTRAL == pytest.approx(balance[1], rel=1e-3)
    found = read_raw(tmp_path / "a.dng", balance)
    assert found.dtype == np.float32 and found.shape == (SIZE, SIZE, 3)
    assert found[:, :12] == pytest.approx(light[:, :12], abs=1e-3)
    assert found[:, 20:] == pytest.approx(light[:, 20:], abs=1e-3)
    write_dng(tmp_path / "a.dng", 3 * light)
    assert (read_raw(tmp_path / "a.dng", balance)[:, 20:] >= CLIPPED).all()


def test_mixtures_of_clipped_and_other_colours_are_told(tmp_path):
    """Of a sensor whose green is clipped, neither red nor blue of sRGB is known."""
    light = grey(0.2, 0.2, 0.2).copy()
    light[:, 8:16] = (0.6, 1.5, 0.6)
    light[:, 16:24] = 1.5  # beyond white in all
    write_dng(tmp_path / "a.dng", light, sees=SEES)
    balance, _ = raw_balances(tmp_path / "a.dng")
    told, found = raw_told(tmp_path / "a.dng", balance), read_raw(tmp_path / "a.dng", balance)
    write_dng(tmp_path / "b.dng", light / 3, sees=SEES)
    true = 3 * read_raw(tmp_path / "b.dng", balance)
    assert raw_told(tmp_path / "b.dng", balance).all()
    # Interpolation between colours of the mosaic reaches two pixels far.
    inner = {"dark": np.s_[:, :6], "green": np.s_[:, 10:14], "white": np.s_[:, 18:22]}
    assert told[inner["dark"]].all() and told[inner["white"]].all()
    assert not told[inner["green"]].any()
    assert found[inner["dark"]] == pytest.approx(true[inner["dark"]], abs=2e-3)
    assert (found[inner["white"]] >= CLIPPED).all()
    assert (np.abs(found - np.minimum(true, 1))[inner["green"]].max(2) > 0.05).all()


def test_pixels_of_camera_raw_that_say_nothing_are_masked(project, meshes, tmp_path):
    light = grey(0.4, 0.2, 0.1).copy()
    light[:, 8:16] = (0.2, 1.5, 0.2)
    write_dng(project / "jpg" / "1.DNG", light, 200)
    import_data(project, tmp_path / "data", meshes, ImportSettings(holdout=0), tell=quiet)
    views = Dataset.load(tmp_path / "data").views
    assert read_masked(views[0])[1].all(), "its mask is there because another view has one"
    counted = read_masked(views[1])[1]
    assert not counted[:, 10:14].any() and counted[:, :6].all() and counted[:, 18:].all()


def test_camera_raw_takes_the_place_of_photographs(captured, project, meshes, tmp_path):
    told = []
    settings = ImportSettings(holdout=0)
    import_data(project, tmp_path / "data", meshes, settings, tell=told.append)
    views = Dataset.load(tmp_path / "data").views
    assert [view.image.name for view in views] == ["0.exr", "1.exr", "2.exr"]
    for view, known in zip(views, captured.views, strict=True):
        assert view.encoding == "linear" and view.clipped == CLIPPED
        assert np.array_equal(view.camera.to_world, known.camera.to_world)
        pixels = read_photograph(view)[..., :3]
        assert pixels == pytest.approx(grey(0.4, 0.2, 0.1), abs=1e-3)
    exposures = [view.exposure for view in views]
    assert exposures == pytest.approx([0.5, 1, 2], rel=1e-3)
    assert any("(2.0 stops apart), by EXIF" in line for line in told)


def test_camera_raw_beside_its_photograph_is_told(project, meshes, tmp_path):
    Image.fromarray(np.full((SIZE, SIZE, 3), 128, np.uint8)).save(project / "jpg" / "1.jpg")
    told = []
    settings = ImportSettings(holdout=0)
    import_data(project, tmp_path / "data", meshes, settings, tell=told.append)
    (line,) = (line for line in told if "is not read" in line)
    assert "camera RAW beside its photograph is not read (1): jpg/1.jpg; move it" in line
    names = [view.image.name for view in Dataset.load(tmp_path / "data").views]
    assert names == ["0.exr", "1.jpg", "2.exr"]


def test_edges_that_photographs_lack_are_cut_off(captured, meshes, tmp_path):
    """Sensors have some rows and columns that the camera's own JPEG file lacks."""
    wide, tall, edge = 104, 104, 2
    light = np.full((tall + edge, wide + edge, 3), 0.5)
    light[:1], light[-1:], light[:, :1], light[:, -1:] = 0.05, 0.05, 0.05, 0.05
    write_dng(tmp_path / "nerf" / "a.dng", light)
    lens = {"fl_x": 80.0, "fl_y": 80.0, "w": wide, "h": tall}
    pose = captured.views[0].camera.to_world.tolist()
    frames = [{"file_path": "a.jpg", "transform_matrix": pose}]
    write_json(tmp_path / "nerf" / "transforms.json", lens | {"frames": frames})
    import_data(tmp_path / "nerf", tmp_path / "data", meshes, tell=quiet)
    (view,) = Dataset.load(tmp_path / "data").views
    pixels = read_photograph(view)[..., :3]
    assert pixels.shape == (tall, wide, 3)
    for side in (pixels[1], pixels[-2], pixels[:, 1], pixels[:, -2]):
        assert side[2:-2] == pytest.approx(0.5, abs=2e-3)
    write_json(tmp_path / "nerf" / "transforms.json", lens | {"w": 96} | {"frames": frames})
    with pytest.raises(ImportFaults, match="its camera is for 96 x 104 pixels, it has 106 x 106"):
        import_data(tmp_path / "nerf", tmp_path / "none", meshes, tell=quiet)


def test_photographs_have_one_white_balance(project, meshes, tmp_path):
    write_dng(project / "jpg" / "1.DNG", grey(0.4, 0.2, 0.1), 100, (0.4, 1.0, 0.8))
    told = []
    import_data(project, tmp_path / "data", meshes, ImportSettings(holdout=0), tell=told.append)
    for view in Dataset.load(tmp_path / "data").views:
        pixels = read_photograph(view)[..., :3]
        assert pixels == pytest.approx(grey(0.4, 0.2, 0.1), abs=1e-3)
    assert any("white balance: cameras chose several" in line for line in told)


def test_another_sensor_has_the_white_balance_in_its_own_factors(project, meshes, tmp_path):
    """Photographs of two cameras in daylight, which sees the second one with less red."""
    colour = np.array([0.4, 0.2, 0.1])
    for number, sees in enumerate((SEES, SEES_LESS_RED, SEES)):
        sensor = np.array(sees) @ np.array(TO_XYZ)
        white = sensor.sum(1)
        seen, chosen = sensor @ colour / white.max(), white / white.max()
        file = project / "jpg" / f"{number}.DNG"
        write_dng(file, grey(*seen / NEUTRAL), 100, chosen, sees)
    told = []
    import_data(project, tmp_path / "data", meshes, ImportSettings(holdout=0), tell=told.append)
    for view in Dataset.load(tmp_path / "data").views:
        assert read_photograph(view)[..., :3] == pytest.approx(grey(*colour), abs=5e-3)
    assert any("white balance: sensors differ" in line for line in told)


def test_damaged_camera_raw_is_a_fault(project, meshes, tmp_path):
    whole = (project / "jpg" / "1.DNG").read_bytes()
    (project / "jpg" / "0.DNG").write_bytes(b"no camera wrote this")
    (project / "jpg" / "1.DNG").write_bytes(whole[: len(whole) // 2])
    (project / "jpg" / "2.DNG").rename(project / "jpg" / "3.DNG")
    with pytest.raises(ImportFaults) as caught:
        import_data(project, tmp_path / "data", meshes, tell=quiet)
    faults = "; ".join(caught.value.faults)
    assert "cannot be read (Input/output error): jpg/0.jpg, jpg/1.jpg" in faults
    assert "does not exist: jpg/2.jpg" in faults
    with pytest.raises(UserError, match="cannot be read"):
        read_raw(project / "jpg" / "1.DNG")
