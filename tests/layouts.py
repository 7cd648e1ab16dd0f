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
