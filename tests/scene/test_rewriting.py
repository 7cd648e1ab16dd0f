"""A scene that is written again, or edited, with its own values renders as before."""

import tarfile

import mitsuba as mi
import numpy as np
import pytest

from unbake.acquisition.built_in import SCENES
from unbake.imaging.metrics import psnr
from unbake.scene import edit
from unbake.scene import parse as scenes
from unbake.scene.emitters import named_emitters

#: Archives of published scenes; `envmaps_blender` has no scene.
SHARED = ["dragon", "kitchen", "lego", "living-room-2", "plant", "spot", "staircase"]
SHARED += ["veach-ajar", "vegboard"]
#: PSNR that counts as the same picture, its brightest percent clipped.
SAME = 60.0


def picture(scene, spp=8, size=48):
    """Path traced through the scene's own camera, always with the same random numbers."""
    sensor = scene.sensors()[0]
    parameters = mi.traverse(sensor)
    parameters["film.size"] = [size, size]
    parameters.update()
    integrator = mi.load_dict({"type": "path", "max_depth": 4})
    image = mi.render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=0)
    return np.array(image)[..., :3]


def loaded(path):
    """As Mitsuba loads it: in order, one node after the other, so that light is sampled alike."""
    return mi.load_file(str(path), parallel=False, optimize=False)


def assert_same_picture(image, reference):
    assert reference.std() > 0
    scale = max(float(np.percentile(reference, 99)), 1e-6)
    assert psnr(np.minimum(image / scale, 1), np.minimum(reference / scale, 1)) >= SAME


def assert_rewritten_alike(path, folder, spp=8):
    folder.mkdir()
    written = scenes.write(scenes.parse(path), folder)
    assert_same_picture(picture(loaded(written), spp), picture(loaded(path), spp))


@pytest.mark.parametrize("name", SCENES)
def test_a_built_in_scene_is_written_alike(name, built_in, tmp_path):
    assert_rewritten_alike(built_in(name), tmp_path / "written")


@pytest.mark.slow
@pytest.mark.parametrize("name", SHARED)
def test_a_published_scene_is_written_alike(name, scenes_dir, tmp_path):
    with tarfile.open(scenes_dir / f"{name}.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    files = sorted((tmp_path / name).glob("scene*.xml"))
    assert files
    for number, path in enumerate(files):
        # Rotations are written as angles, so that a few paths take another turn.
        assert_rewritten_alike(path, tmp_path / f"written-{number}", spp=64)


@pytest.mark.parametrize("name", ["cornell", "annex"])
def test_lights_of_their_own_strength_change_nothing(name, built_in):
    def instantiated(change):
        scene = scenes.parse(built_in(name))
        change(scene)
        return mi.parser.instantiate(scene.config, scene.state)

    def own_strengths(scene):
        strengths = [light.strength for light in named_emitters(scene)]

        def textures(count):
            assert count == len(strengths)
            return [
                mi.load_dict({"type": "srgb", "color": list(rgb), "unbounded": True})
                for rgb in strengths
            ]

        edit.set_emission(scene, textures)

    reference = picture(instantiated(lambda scene: None))
    assert_same_picture(picture(instantiated(own_strengths)), reference)
