"""COLMAP models: text, binary, shared and separate cameras, folders, rigs, and real ones."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from layouts import (
    codes,
    photograph_through,
    quiet,
    same_as_captured,
    save,
    straightened_as_seen,
)

from unbake.dataset.views import Dataset
from unbake.errors import UserError
from unbake.imaging.coded import encode
from unbake.importing import colmap
from unbake.importing.colmap import find_model, read_colmap
from unbake.importing.faults import Faults, ImportFaults
from unbake.importing.frames import _lens
from unbake.importing.import_data import import_data
from unbake.importing.settings import ImportSettings
from unbake.importing.source import Reading

pycolmap = pytest.importorskip("pycolmap", reason="COLMAP models need pycolmap")

#: Real photographs and models, which are not part of the repository.
REAL = Path(__file__).parents[3] / "shared" / "real"
real = pytest.mark.skipif(not REAL.is_dir(), reason="the real photographs are not here")
TURN = np.diag([1.0, -1.0, -1.0, 1.0])


def rigid(matrix):
    return pycolmap.Rigid3d(np.ascontiguousarray(matrix[:3]))


def model_of(dataset, folder, *, shared=True, name="{}.png"):
    """A reconstruction with the cameras of a data set, and photographs of 8 bits."""
    found = pycolmap.Reconstruction()
    for number, view in enumerate(dataset.views, 1):
        camera = view.camera
        if number == 1 or not shared:
            params = [camera.fl_x, camera.fl_y, camera.cx, camera.cy]
            lens = pycolmap.Camera(
                model="PINHOLE", width=camera.width, height=camera.height, params=params
            )
            lens.camera_id = number
            found.add_camera_with_trivial_rig(lens)
        image = pycolmap.Image(
            name=name.format(view.name), camera_id=1 if shared else number, image_id=number
        )
        pose = np.linalg.inv(camera.to_world @ TURN)
        found.add_image_with_trivial_frame(image, rigid(pose))
        save(codes(view), folder / "images" / name.format(view.name))
    return found


@pytest.mark.parametrize("binary", [True, False], ids=["binary", "text"])
@pytest.mark.parametrize("shared", [True, False], ids=["one camera", "a camera each"])
def test_colmap_comes_back(binary, shared, captured, meshes, tmp_path):
    project = tmp_path / "project"
    model = project / "sparse" / "0"
    model.mkdir(parents=True)
    found = model_of(captured, project, shared=shared)
    (found.write_binary if binary else found.write_text)(str(model))
    told = []
    settings = ImportSettings(holdout=len(captured.views))
    import_data(project, tmp_path / "data", meshes, settings, tell=told.append)
    assert told[0].startswith("COLMAP: 2 training and 1 held-out views of 16 x 16 pixels")
    same_as_captured(captured, tmp_path / "data")


def test_images_in_folders_are_found_and_may_lie_elsewhere(captured, meshes, tmp_path):
    model = tmp_path / "model"
    model.mkdir()
    model_of(captured, tmp_path / "elsewhere", name="left/{}.png").write_text(str(model))
    with pytest.raises(ImportFaults, match="there is no folder of images"):
        import_data(model, tmp_path / "data", meshes, tell=quiet)
    images = tmp_path / "elsewhere" / "images"
    settings = ImportSettings(holdout=len(captured.views))
    import_data(model, tmp_path / "data", meshes, settings, images=images, tell=quiet)
    same_as_captured(captured, tmp_path / "data")


def test_the_cameras_of_a_rig_have_their_places(captured, tmp_path):
    """Two cameras on one rig: the second stands where the rig's pose and its own put it."""
    first, second = captured.views[:2]
    world_to = [np.linalg.inv(view.camera.to_world @ TURN) for view in (first, second)]
    found, kind = pycolmap.Reconstruction(), pycolmap.SensorType.CAMERA
    rig, frame = pycolmap.Rig(), pycolmap.Frame()
    rig.rig_id = frame.frame_id = frame.rig_id = 1
    for number, view in enumerate((first, second), 1):
        params = [view.camera.fl_x, view.camera.cx, view.camera.cy]
        lens = pycolmap.Camera(model="SIMPLE_PINHOLE", width=16, height=16, params=params)
        lens.camera_id = number
        found.add_camera(lens)
        sensor = pycolmap.sensor_t(kind, number)
        if number == 1:
            rig.add_ref_sensor(sensor)
        else:
            rig.add_sensor(sensor, rigid(world_to[1] @ np.linalg.inv(world_to[0])))
        frame.add_data_id(pycolmap.data_t(sensor, number))
    found.add_rig(rig)
    frame.rig_from_world = rigid(world_to[0])
    found.add_frame(frame)
    for number, view in enumerate((first, second), 1):
        image = pycolmap.Image(name=f"cam{number}/0.png", camera_id=number, image_id=number)
        image.frame_id = 1
        found.add_image(image)
        save(codes(view), tmp_path / "images" / image.name)
    found.register_frame(1)
    found.write_binary(str(tmp_path))
    faults = Faults()
    shots = read_colmap(tmp_path, Reading(), faults).shots
    assert not faults and [shot.name for shot in shots] == ["cam1/0.png", "cam2/0.png"]
    for shot, view in zip(shots, (first, second), strict=True):
        assert np.abs(shot.to_world - view.camera.to_world).max() < 1e-6


def test_our_lenses_are_those_of_colmap():
    points = np.random.default_rng(0).uniform(-0.6, 0.6, (50, 2))
    keys = {"w": 640, "h": 480, "fl_x": 500.0, "fl_y": 510.0, "cx": 320.0, "cy": 250.0}
    for model, names in {
        "OPENCV": ("k1", "k2", "p1", "p2"),
        "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4"),
    }.items():
        values = [-0.1, 0.02, 0.003, -0.004]
        camera = pycolmap.Camera(
            model=model, width=640, height=480, params=[500, 510, 320, 250, *values]
        )
        lens = _lens(
            keys | {"camera_model": model} | dict(zip(names, values, strict=True)), 640, 480, "here"
        )
        theirs = camera.img_from_cam(np.c_[points, np.ones(50)])
        assert np.abs(lens.pixels(points) - theirs).max() < 1e-9


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_RADIAL", [80, 45, 33, -0.1]),
        ("OPENCV", [80, 81, 45, 33, -0.2, 0.05, 0.003, -0.002]),
        ("OPENCV_FISHEYE", [80, 81, 45, 33, 0.02, -0.01, 0, 0]),
    ],
)
def test_distortion_is_taken_out(model, params, captured, meshes, tmp_path):
    camera = pycolmap.Camera(model=model, width=96, height=64, params=params)
    camera.camera_id = 1
    found = pycolmap.Reconstruction()
    found.add_camera_with_trivial_rig(camera)
    pose = np.linalg.inv(captured.views[0].camera.to_world @ TURN)
    image = pycolmap.Image(name="a.png", camera_id=1, image_id=1)
    found.add_image_with_trivial_frame(image, rigid(pose))
    (tmp_path / "sparse").mkdir()
    found.write_binary(str(tmp_path / "sparse"))
    lens = colmap._lens(camera)
    photograph = photograph_through(lens)
    save(np.round(encode(photograph) / 257).astype(np.uint8), tmp_path / "images" / "a.png")
    told = []
    import_data(tmp_path, tmp_path / "data", meshes, tell=told.append)
    assert "1 undistorted" in told[0]
    straightened_as_seen(Dataset.load(tmp_path / "data").views[0], lens, 0.006)


def test_faults_of_a_model_are_told(captured, meshes, tmp_path):
    project = tmp_path / "project"
    model = project / "sparse"
    model.mkdir(parents=True)
    model_of(captured, project).write_text(str(model))
    names = sorted(file.name for file in (project / "images").iterdir())
    (project / "images" / names[0]).unlink()
    save(np.zeros((8, 9, 3), np.uint8), project / "images" / names[1])
    with pytest.raises(ImportFaults) as caught:
        import_data(project, tmp_path / "data", meshes, tell=quiet)
    assert caught.value.faults == (
        f"the image does not exist: {names[0]}. --leave-out-missing imports the others",
        f"its camera is for 16 x 16 pixels, it has 9 x 8: {names[1]}. "
        "Give the photographs that were posed, whole or scaled as a whole",
    )
    (model / "images.txt").write_text("# nothing\n")
    with pytest.raises(ImportFaults, match="no image of the model has a pose"):
        import_data(project, tmp_path / "data", meshes, tell=quiet)
    (model / "cameras.txt").write_text("1 NO_SUCH_MODEL 16 16 1 2 3\n")
    with pytest.raises(UserError, match=r"pycolmap cannot read the model.*Write the model again"):
        import_data(project, tmp_path / "data", meshes, tell=quiet)


def test_what_a_model_leaves_out_is_told(captured, meshes, tmp_path):
    project = tmp_path / "project"
    models = [project / "sparse" / name for name in ("0", "1")]
    for model in models:
        model.mkdir(parents=True)
        model_of(captured, project).write_text(str(model))
    save(np.zeros((16, 16, 3), np.uint8), project / "images" / "alone.png")
    told = []
    import_data(project, tmp_path / "data", meshes, tell=told.append)
    assert f"{project / 'sparse'} has other models, left out: 1" in told
    assert "1 of 4 photographs have no pose, left out: alone.png" in told


def test_a_model_that_is_elsewhere_is_told_with_its_place(captured, tmp_path):
    project = tmp_path / "project"
    (project / "sparse").mkdir(parents=True)
    model_of(captured, project).write_text(str(project / "sparse"))
    box = trimesh.creation.box((4, 2, 2))
    box.apply_translation([90, 0, -7])
    box.export(tmp_path / "box.ply")
    with pytest.raises(UserError, match=r"4 units wide around .90, 0, -7.; the cameras") as caught:
        import_data(project, tmp_path / "data", [tmp_path / "box.ply"], tell=quiet)
    assert "one frame and unit" in caught.value.remedy and "--keep" not in caught.value.remedy


def test_cameras_that_see_all_around_are_refused(captured, meshes, tmp_path):
    project = tmp_path / "project"
    model = project / "sparse"
    model.mkdir(parents=True)
    model_of(captured, project).write_text(str(model))
    for line, told in (
        ("1 EQUIRECTANGULAR 16 16 16 16\n", "EQUIRECTANGULAR|pycolmap cannot read"),
        ("1 PINHOLE 16 16 10 0 8 8\n", "the focal lengths of its camera are 10 and 0"),
    ):
        (model / "cameras.txt").write_text(line)
        with pytest.raises(UserError, match=told):
            import_data(project, tmp_path / "data", meshes, tell=quiet)


def test_photographs_are_looked_for_within_the_project(tmp_path):
    """Not beside it, where those of other projects may be."""
    usual = [".", "sparse", "sparse/0", "sparse/3", "colmap/sparse/0", "dense/sparse", "model"]
    project = tmp_path / "project"
    models = [project / name for name in (*usual, "another")]
    (tmp_path / "images").mkdir()
    for model in models:
        model.mkdir(parents=True, exist_ok=True)
        assert colmap._folder_of_images(model) is None
    (project / "images").mkdir()
    found = [colmap._folder_of_images(model) for model in models]
    assert found == [project.resolve() / "images"] * len(usual) + [None]


def test_a_project_that_has_no_model_is_none(tmp_path):
    assert find_model(tmp_path) is None


@real
@pytest.mark.parametrize("name", ["bin", "txt", "txt_not_shared", "txt_missing_and_subfolders"])
def test_real_models_project_their_points_where_they_were_seen(name, tmp_path):
    """The images are not there: grey ones of their size stand for them."""
    model = REAL / "colmap-models" / name
    found = pycolmap.Reconstruction(str(model))
    for image in found.images.values():
        file = tmp_path / "images" / image.name
        file.parent.mkdir(parents=True, exist_ok=True)
        header = grey_header(image.camera.width, image.camera.height)
        file.write_bytes(header)
    faults = Faults()
    shots = {s.name: s for s in read_colmap(model, Reading(tmp_path / "images"), faults).shots}
    assert not faults and len(shots) == found.num_reg_images()
    errors = []
    for image in found.images.values():
        shot = shots[image.name]
        seen = [p for p in image.points2D if p.has_point3D()]
        world = np.array([found.points3D[p.point3D_id].xyz for p in seen])
        local = (world - shot.to_world[:3, 3]) @ shot.to_world[:3, :3]
        points = np.stack([local[:, 0], -local[:, 1]], 1) / -local[:, 2:]
        errors.append(np.linalg.norm(shot.lens.pixels(points) - [p.xy for p in seen], axis=1))
    assert 0.4 < np.concatenate(errors).mean() < 0.8  # pixels; the means of the models


def grey_header(width, height):
    """The beginning of a JPEG file of that size, which is all that is read of it here."""
    frame = b"\xff\xc0\0\x11\x08" + height.to_bytes(2, "big") + width.to_bytes(2, "big")
    return b"\xff\xd8" + frame + b"\x03" + bytes(9) + bytes(width * height // 1000)


@real
def test_real_photographs_become_a_data_set(tmp_path):
    source, told = REAL / "sceaux", []
    import_data(source, tmp_path / "data", [source / "mesh.ply"], tell=told.append)
    found = Dataset.load(tmp_path / "data")
    assert (len(found.train), len(found.heldout)) == (8, 2)
    assert told[0].endswith("of 1024 x 769 pixels")
    assert "(1.3 stops apart), by EXIF" in told[1]
    assert "one part, 14,709 triangles; 59 % of the pixels see it (54 to 70 %" in told[3]
    view = found.views[0]
    assert view.camera.cx == pytest.approx(525.25, abs=0.01)
    assert (tmp_path / "data" / "images" / "00000.jpg").read_bytes() == (
        source / "images" / "00000.jpg"
    ).read_bytes()
