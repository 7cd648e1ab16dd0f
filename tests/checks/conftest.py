"""Data sets of some views that are large enough to have edges, to be copied and spoilt."""

import json
import shutil

import numpy as np
import pytest

from unbake.acquisition.capture import capture
from unbake.acquisition.settings import CaptureSettings
from unbake.imaging.pictures import read_exr, write_exr

SMALL = CaptureSettings(views=8, held_out=1, resolution=40, spp=16, max_depth=4)


@pytest.fixture(scope="session")
def captured(tmp_path_factory):
    """Capture a built-in scene, once: `captured(name)` is its folder, to be read alone."""
    folders = {}

    def make(name):
        if name not in folders:
            folders[name] = tmp_path_factory.mktemp("checked") / name
            capture(name, folders[name], SMALL, tell=lambda line: None)
        return folders[name]

    return make


class Spoilt:
    """A copy of a data set, with faults."""

    def __init__(self, folder):
        self.folder = folder
        self.content = json.loads((folder / "transforms.json").read_text())

    @property
    def frames(self):
        """Frames of the training views."""
        return [f for f in self.content["frames"] if f["split"] == "train"]

    def poses(self, change, frames=None):
        """Change matrices, (4, 4) each."""
        for frame in self.content["frames"] if frames is None else frames:
            frame["transform_matrix"] = change(np.array(frame["transform_matrix"])).tolist()

    def picture(self, frame, change):
        """Change an image, (height, width, 4)."""
        file = self.folder / frame["file_path"]
        write_exr(file, change(read_exr(file)))

    def save(self):
        (self.folder / "transforms.json").write_text(json.dumps(self.content))
        return self.folder


@pytest.fixture
def spoilt(captured, tmp_path):
    """`spoilt(name)`: a copy of a captured scene."""

    def make(name):
        return Spoilt(shutil.copytree(captured(name), tmp_path / "data"))

    return make
