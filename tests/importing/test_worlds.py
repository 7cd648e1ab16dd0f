"""The frame of cameras and that of meshes: found, told, and brought together."""

import json
import shutil

import numpy as np
import pytest
import trimesh
from layouts import APPLIED, intrinsics, quiet, same_as_captured, write_colmap, write_nerfstudio

from unbake.dataset.views import Dataset
from unbake.errors import UserError
from unbake.importing import import_data as importing
from unbake.importing.faults import Faults, ImportFaults
from unbake.importing.frames import read_one_file
from unbake.importing.import_data import import_data
from unbake.importing.meshes import TO_Z_UP, read_parts
from unbake.importing.nerfstudio import TURNED_ONCE
from unbake.importing.settings import ImportSettings
from unbake.importing.source import Reading
from unbake.importing.world import read_matrix

#: Rows z, x, y, as nerfstudio has the worlds of Polycam and Metashape.
ROWS_TURNED = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def write_turned(captured, folder, turn, **top):
    """A `transforms.json` without `applied_transform`, whose world is turned by (4, 4)."""
    write_nerfstudio(captured, folder)
    content = json.loads((folder / "transforms.json").read_text())
    del content["applied_transform"]
    for frame, view in zip(content["frames"], captured.views, strict=True):
        frame["transform_matrix"] = (turn @ view.camera.to_world).tolist()
    (folder / "transforms.json").write_text(json.dumps(content | top))
    return folder


def notes_of(folder):
    return read_one_file(folder / "transforms.json", Reading(), Faults()).world.notes


def moved(meshes, matrix, folder):
    """Copies of meshes after a similarity (4, 4)."""
    folder.mkdir()
    for mesh in meshes:
        loaded = trimesh.load_mesh(mesh, process=False)
        loaded.apply_transform(matrix)
        loaded.export(folder / mesh.name)
    return sorted(folder.iterdir())


def positions(files):
    faults = Faults()
    parts = sorted(read_parts(sorted(files), faults), key=lambda part: part.name)
    assert not faults
    return np.concatenate([part.positions for part in parts])


def same_geometry(out, meshes, matrix=None):
    """Whether the mesh of a data set is that of files after a similarity."""
    wanted, found = positions(meshes), positions((out / "scene" / "meshes").iterdir())
    if matrix is not None:
        wanted = wanted @ matrix[:3, :3].T + matrix[:3, 3]
    return np.allclose(found, wanted, atol=1e-4 * np.abs(wanted).max())


# ----------------------------------------------------------------------- what nerfstudio has turned


@pytest.mark.parametrize("beside", ["colmap/sparse/0", "../colmap"])
def test_a_model_of_colmap_tells_how_cameras_were_turned(beside, captured, meshes, tmp_path):
    """As older nerfstudio did, and as ScanNet++ has it, with the model one folder up."""
    source = write_turned(captured, tmp_path / "dslr" / "nerfstudio", TURNED_ONCE)
    write_colmap(captured, tmp_path / "project")
    shutil.copytree(tmp_path / "project" / "sparse" / "0", source / beside)
    told = []
    import_data(source, tmp_path / "data", meshes, tell=told.append)
    same_as_captured(captured, tmp_path / "data")
    assert any("which has them turned" in line for line in told)
    reading = Reading(keep_applied_transform=True)
    found = read_one_file(source / "transforms.json", reading, Faults())
    wanted = [TURNED_ONCE @ view.camera.to_world for view in captured.views]
    assert np.allclose([shot.to_world for shot in found.shots], wanted)


def test_cameras_that_were_not_turned_are_left_without_a_word(captured, meshes, tmp_path):
    """With `keep_original_world_coordinate`, nerfstudio leaves the key out, too."""
    source = write_turned(captured, tmp_path / "nerf", np.eye(4))
    write_colmap(captured, source / "colmap")
    assert notes_of(source) == ()
    import_data(source, tmp_path / "data", meshes, tell=quiet)
    same_as_captured(captured, tmp_path / "data")


def test_cameras_that_no_model_explains_are_told_as_two_cases(captured, tmp_path):
    shifted = TURNED_ONCE.copy()
    shifted[:3, 3] = (0, 0, 5)
    source = write_turned(captured, tmp_path / "nerf", shifted)
    assert notes_of(source) == ()
    write_colmap(captured, source / "colmap")
    (note,) = notes_of(source)
    assert "older nerfstudio turned" in note and "where it has not turned them" in note
    shutil.rmtree(source / "colmap" / "sparse" / "0")
    (source / "colmap" / "sparse" / "0").mkdir()
    assert notes_of(source) == (note,)


@pytest.mark.parametrize("turn", [TURNED_ONCE, np.eye(4)], ids=["turned", "not turned"])
@pytest.mark.parametrize("read", [True, False], ids=["with its model", "without"])
def test_exported_meshes_fit_where_nerfstudio_takes_the_turn_for_done(
    turn, read, captured, meshes, tmp_path
):
    """Without the key and beside `colmap/sparse/0`, it notes that turn, whether it was or not."""
    source = write_turned(captured, tmp_path / "nerf", turn)
    if read:
        write_colmap(captured, source / "colmap")
    else:
        (source / "colmap" / "sparse" / "0").mkdir(parents=True)
    trained = trimesh.transformations.random_rotation_matrix(np.array([0.2, 0.5, 0.8]))
    trained[:3, 3] = (0.5, -1, 2)
    noted = {"transform": (trained @ TURNED_ONCE)[:3].tolist(), "scale": 0.25}
    file = tmp_path / "dataparser_transforms.json"
    file.write_text(json.dumps(noted))
    scaled = np.diag([0.25, 0.25, 0.25, 1]) @ trained @ turn
    exported = moved(meshes, scaled, tmp_path / "exported")
    import_data(source, tmp_path / "data", exported, mesh_transform=file, tell=quiet)
    if read:
        same_as_captured(captured, tmp_path / "data")
    assert same_geometry(tmp_path / "data", meshes, None if read else turn)


def test_a_scale_that_was_applied_is_no_part_of_the_translation(captured, meshes, tmp_path):
    """Nerfstudio trains at s (R a A x + t), and notes R A, t and s a."""
    source, a, s = tmp_path / "nerf", 0.25, 0.5
    write_nerfstudio(captured, source)
    content = json.loads((source / "transforms.json").read_text())
    content["applied_scale"] = a
    for frame in content["frames"]:
        for row in frame["transform_matrix"][:3]:
            row[3] *= a
    (source / "transforms.json").write_text(json.dumps(content))
    trained = trimesh.transformations.random_rotation_matrix(np.array([0.1, 0.4, 0.7]))
    trained[:3, 3] = (3, -1, 2)
    noted = {"transform": (trained @ APPLIED)[:3].tolist(), "scale": s * a}
    file = tmp_path / "dataparser_transforms.json"
    file.write_text(json.dumps(noted))
    scaled = [np.diag([factor] * 3 + [1.0]) for factor in (s, a)]
    exported = moved(meshes, scaled[0] @ trained @ scaled[1] @ APPLIED, tmp_path / "exported")
    import_data(source, tmp_path / "data", exported, mesh_transform=file, tell=quiet)
    same_as_captured(captured, tmp_path / "data")
    assert same_geometry(tmp_path / "data", meshes)


# ------------------------------------------------------------------------------- moves of the mesh


@pytest.mark.parametrize("form", ["numbers", "text", "json", "rows"])
def test_a_mesh_of_polycam_comes_by_its_matrix(form, captured, meshes, tmp_path):
    source = write_turned(captured, tmp_path / "nerf", ROWS_TURNED, orientation_override="none")
    (note,) = notes_of(source)
    numbers = note.split("--mesh-matrix ")[1].split()
    assert np.array_equal(read_matrix(numbers), ROWS_TURNED)
    given, file = numbers, tmp_path / "matrix.txt"
    if form == "text":
        file.write_text("\n".join(" ".join(map(str, row)) for row in ROWS_TURNED))
    elif form == "json":
        file.write_text(json.dumps(ROWS_TURNED.tolist()))
    elif form == "rows":
        file.write_text(json.dumps(ROWS_TURNED[:3].tolist()))
    given = numbers if form == "numbers" else file
    import_data(source, tmp_path / "data", meshes, mesh_matrix=given, tell=quiet)
    assert same_geometry(tmp_path / "data", meshes, ROWS_TURNED)


def test_a_mesh_of_metashape_comes_by_its_scale(captured, meshes, tmp_path):
    turned = {"applied_transform": ROWS_TURNED[:3].tolist()}
    source = write_turned(captured, tmp_path / "nerf", ROWS_TURNED, **turned)
    assert any("--mesh-scale with the number 1 / S" in note for note in notes_of(source))
    large = moved(meshes, np.diag([8.0, 8, 8, 1]), tmp_path / "large")
    settings = ImportSettings(mesh_scale=1 / 8)
    import_data(source, tmp_path / "data", large, settings, tell=quiet)
    same_as_captured(captured, tmp_path / "data")
    assert same_geometry(tmp_path / "data", meshes)


def test_the_matrix_of_a_mesh_comes_after_its_scale(captured, meshes, tmp_path, unbake):
    source = write_turned(captured, tmp_path / "nerf", np.eye(4))
    matrix = TO_Z_UP.copy()
    matrix[:3, 3] = (0.5, 0.25, -0.125)
    command = ["import", source, "--out", tmp_path / "data", "--mesh-scale", "2", "--mesh-matrix"]
    command += [str(value) for value in matrix.ravel()]
    for mesh in meshes:
        command += ["--mesh", mesh]
    assert unbake(*command).status == 0
    assert same_geometry(tmp_path / "data", meshes, matrix @ np.diag([2.0, 2, 2, 1]))


@pytest.mark.parametrize(
    ("given", "told"),
    [
        (["1"] * 5, "the matrix has 5 numbers, and not 16"),
        (["x"] * 16, "words that are no numbers"),
        (["nan"] * 16, "no rotation with one scale"),
        (list("1000010000100005"), "no rotation with one scale"),
        (list("2000010000100001"), "no rotation with one scale"),
        (["-1", *"000010000100001"], "no rotation with one scale"),
    ],
)
def test_a_matrix_that_is_none_is_a_fault(given, told, captured, meshes, tmp_path):
    source = write_turned(captured, tmp_path / "nerf", np.eye(4))
    with pytest.raises(ImportFaults, match=told):
        import_data(source, tmp_path / "data", meshes, mesh_matrix=given, tell=quiet)
    with pytest.raises(ImportFaults, match="matrix"):
        import_data(source, tmp_path / "data", meshes, mesh_matrix=["none"], tell=quiet)


def test_a_mesh_of_another_frame_is_far_from_the_origin_only_where_it_is_moved_to(
    captured, meshes, tmp_path
):
    """OBJ has double precision: a matrix brings it from UTM coordinates, but not there."""
    source = write_turned(captured, tmp_path / "nerf", np.eye(4))
    away = trimesh.transformations.translation_matrix((450_000, 5_400_000, 100))
    near, far = trimesh.load(meshes[0], force="mesh", process=False), tmp_path / "far.obj"
    near.export(tmp_path / "near.obj", digits=9)
    near.apply_transform(away)
    near.export(far, digits=9)
    back = np.linalg.inv(away).ravel().tolist()
    import_data(source, tmp_path / "moved", [far], mesh_matrix=back, tell=quiet)
    assert same_geometry(tmp_path / "moved", [tmp_path / "near.obj"])
    with pytest.raises(ImportFaults, match=r"from the origin, where single precision has steps"):
        import_data(source, tmp_path / "none", meshes, mesh_matrix=away.ravel().tolist())


# ------------------------------------------------------------------- meshes that no photograph sees


def behind(captured, turn):
    """A shift of the world, (4, 4), whose turned place lies behind all cameras in the other."""
    backs = np.array([view.camera.to_world[:3, 2] for view in captured.views])
    shifts = 50 * np.concatenate([np.eye(3), -np.eye(3)])
    nearest = [(backs @ (turn[:3, :3] @ shift - shift)).min() for shift in shifts]
    assert max(nearest) > 0
    found = np.eye(4)
    found[:3, 3] = shifts[int(np.argmax(nearest))]
    return found


def test_what_is_known_of_the_frame_is_told_where_no_photograph_sees_the_mesh(
    captured, meshes, tmp_path, monkeypatch
):
    """And before photographs are decoded, which may take long."""
    source = write_turned(captured, tmp_path / "nerf", ROWS_TURNED, orientation_override="none")

    def decoded(*_):
        raise AssertionError("photographs are decoded")

    monkeypatch.setattr(importing, "check_pictures", decoded)
    away = np.linalg.inv(behind(captured, np.zeros((4, 4))))
    far = moved(meshes, away, tmp_path / "far")
    with pytest.raises(UserError, match="no photograph sees the mesh") as caught:
        import_data(source, tmp_path / "data", far, tell=quiet)
    assert "may be of Polycam" in caught.value.remedy
    assert "--mesh-scale" in caught.value.remedy and "--mesh-y-up" not in caught.value.remedy
    assert not (tmp_path / "data").exists()


@pytest.mark.parametrize("given", [False, True])
def test_a_mesh_that_would_be_seen_when_turned_is_told(given, captured, meshes, tmp_path):
    away = behind(captured, TO_Z_UP if given else TO_Z_UP.T)
    source = write_turned(captured, tmp_path / "nerf", away)
    right = away if given else TO_Z_UP.T @ away
    wrong = moved(meshes, right, tmp_path / "wrong")
    with pytest.raises(UserError, match="no photograph sees the mesh") as caught:
        import_data(source, tmp_path / "data", wrong, ImportSettings(mesh_y_up=given), tell=quiet)
    which = "without --mesh-y-up" if given else "with --mesh-y-up"
    assert f"{which}, 3 of 3 photographs would see it" in caught.value.remedy
    settings = ImportSettings(mesh_y_up=not given)
    import_data(source, tmp_path / "data", wrong, settings, tell=quiet)
    assert len(Dataset.load(tmp_path / "data").views) == 3


@pytest.mark.parametrize("given", [False, True])
def test_units_in_which_the_mesh_would_be_seen_are_told(given, captured, meshes, tmp_path):
    """Alone, and with the turn."""
    larger = np.diag([1000.0, 1000, 1000, 1]) @ (np.eye(4) if given else TO_Z_UP.T)
    shift = behind(captured, larger)
    source = write_turned(captured, tmp_path / "nerf", shift)
    wrong = moved(meshes, larger @ shift, tmp_path / "wrong")
    with pytest.raises(UserError, match="no photograph sees the mesh") as caught:
        import_data(source, tmp_path / "data", wrong, tell=quiet)
    told = "with --mesh-scale 0.001" + ("" if given else " --mesh-y-up")
    assert f"; {told}, 3 of 3 photographs would see it" in caught.value.remedy
    settings = ImportSettings(mesh_y_up=not given, mesh_scale=0.001)
    import_data(source, tmp_path / "data", wrong, settings, tell=quiet)


def test_scannet_is_told_where_its_model_is_missing(captured, tmp_path):
    frame = {"file_path": "images/none.png", "transform_matrix": np.eye(4).tolist()}
    lens = intrinsics(captured.views[0].camera)
    source = write_turned(captured, tmp_path / "nerf", TURNED_ONCE, test_frames=[frame], **lens)
    assert any("may be of ScanNet++" in note for note in notes_of(source))
