"""What tests of imports share: pictures, JSON, and the comparison with what was captured."""

import json

import numpy as np
from PIL import Image

from unbake.dataset.views import Dataset, read_photograph
from unbake.imaging.coded import encode

#: A turn and a shift, as nerfstudio applies one to the cameras of COLMAP.
APPLIED = np.array([[0, 1, 0, 1], [1, 0, 0, -2], [0, 0, -1, 3], [0, 0, 0, 1.0]])
#: Exposure time, ISO and f-number, as in EXIF.
SECONDS, ISO, APERTURE = 0x829A, 0x8827, 0x829D


def quiet(line):
    pass


def codes(view):
    """The photograph of a view as 8-bit code values."""
    return np.round(encode(read_photograph(view)[..., :3]) / 257).astype(np.uint8)


def save(pixels, file, exif=None):
    file.parent.mkdir(parents=True, exist_ok=True)
    image = Image.fromarray(pixels)
    options = {}
    if exif is not None:
        tags = Image.Exif()
        tags.get_ifd(0x8769).update(exif)
        options["exif"] = tags
    image.save(file, **options)


def write_json(file, content):
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(json.dumps(content))


def intrinsics(camera):
    names = {"w": "width", "h": "height", "fl_x": "fl_x", "fl_y": "fl_y", "cx": "cx", "cy": "cy"}
    return {key: getattr(camera, name) for key, name in names.items()}


def same_as_captured(captured, out, *, tolerance=1e-6):
    """The imported data set, after a comparison of poses, rays, splits and pictures."""
    found = Dataset.load(out)
    by_name = {view.name: view for view in captured.views}
    assert {view.name for view in found.views} == by_name.keys()
    for view in found.views:
        known = by_name[view.name]
        assert view.split == known.split
        assert np.abs(view.camera.to_world - known.camera.to_world).max() < tolerance
        y, x = np.divmod(np.arange(view.camera.width * view.camera.height), view.camera.width)
        for mine, theirs in zip(
            view.camera.rays(x + 0.5, y + 0.5), known.camera.rays(x + 0.5, y + 0.5), strict=True
        ):
            assert np.abs(mine - theirs).max() < tolerance
        assert view.encoding == "srgb"
        assert np.abs(codes(view).astype(int) - codes(known)).max() <= 1
    return found


def picture_of(points):
    """A smooth picture of directions (n, 2), linear in [0, 1]: (n, 3)."""
    x, y = points.T
    return np.stack([0.5 + 0.3 * np.sin(3 * x), 0.5 + 0.3 * np.cos(2 * y), 0.4 + 0.2 * x * y], 1)


def photograph_through(lens):
    """What a lens sees of it, (H, W, 3): each pixel's direction is found by iteration."""
    y, x = np.divmod(np.arange(lens.width * lens.height), lens.width)
    at, points = np.stack([x + 0.5, y + 0.5], 1), np.zeros((len(x), 2))
    for _ in range(50):
        points += (at - lens.pixels(points)) / (lens.fl_x, lens.fl_y)
    assert np.abs(lens.pixels(points) - at).max() < 1e-6
    return picture_of(points).reshape(lens.height, lens.width, 3)


def straightened_as_seen(view, lens, tolerance):
    """Check a view that was made of `photograph_through`: its pixels, and that it is not beyond."""
    camera = view.camera
    assert camera.fl_x == camera.fl_y
    centre, size = (camera.cx, camera.cy), np.array([camera.width, camera.height])
    corners = np.array([[0, 0], [1, 0], [0, 1], [1, 1]]) * size - centre
    seen = lens.pixels(corners / camera.fl_x)
    assert (seen > -0.5).all() and (seen < size + 0.5).all()
    y, x = np.divmod(np.arange(camera.width * camera.height), camera.width)
    wanted = picture_of((np.stack([x + 0.5, y + 0.5], 1) - centre) / camera.fl_x)
    pixels = read_photograph(view)[..., :3].reshape(-1, 3)
    assert np.abs(pixels - wanted).max() < tolerance
