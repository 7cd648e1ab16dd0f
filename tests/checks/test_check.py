"""What is wrong with a data set is told at once, with the remedy; good data raise no alarm."""

import re
import typing
from dataclasses import replace
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image

from unbake.checks.check import check_data
from unbake.checks.pictures import PictureFacts, blurred, percentage, picture_facts
from unbake.checks.told import ROWS, told_rows
from unbake.dataset import alignment as aligning
from unbake.dataset import quick_check
from unbake.dataset.agreement import exposures, shared_points, turning_light
from unbake.dataset.camera import Camera
from unbake.dataset.findings import Check, Finding, misaligned
from unbake.dataset.mistakes import OPENCV, Mistake, all_mistakes
from unbake.dataset.own_poses import compared
from unbake.dataset.photographs import Photographs
from unbake.dataset.quick_check import quick_findings
from unbake.dataset.small_views import SmallView, seen_by, small_view
from unbake.dataset.views import Dataset
from unbake.errors import UserError
from unbake.imaging.pictures import write_exr
from unbake.importing.world import read_matrix
from unbake.scene.parse import parse
from unbake.scene.triangles import write_mesh

FLIP = np.diag([*np.diag(OPENCV), 1.0])


def found(folder, check=None):
    result = check_data(folder)
    return [f for f in result.findings if check in (None, f.check)]


@pytest.mark.parametrize(
    "name",
    [
        "cornell",
        pytest.param("still", marks=pytest.mark.slow),
        pytest.param("cube", marks=pytest.mark.slow),
        pytest.param("demo", marks=pytest.mark.slow),
    ],
)
def test_good_data_raise_no_alarm(name, captured):
    result = check_data(captured(name))
    assert result.usable
    assert [f for f in result.findings if f.level != "hint" and f.check != "coverage"] == []
    assert result.exposures.spread < 0.3
    assert result.alignment is None or result.alignment.best is None


def test_a_check_that_takes_long_tells_how_far_it_is(cornell, clock):
    lines = []
    check_data(cornell, tell=lines.append)
    assert lines == []
    clock.step = 60.0
    check_data(cornell, tell=lines.append)
    assert lines == ["checking photographs: 1 of 3", "checking photographs: 2 of 3"]


def test_three_faults_are_told_in_one_go(spoilt, unbake):
    data = spoilt("cornell")
    data.poses(lambda pose: pose @ FLIP)
    data.picture(data.frames[2], lambda pixels: pixels[:, :30])
    data.frames[4]["mask_path"] = "masks/train_004.png"
    outcome = unbake("data", "check", data.save())
    assert outcome.status == 2
    text = " ".join(outcome.out.split())
    assert "train_002.exr: the image has 30 x 40 pixels, its frame says 40 x 40" in text
    assert "Correct 'w' and 'h'" in text
    assert "masks/train_004.png: the mask does not exist. Add it, or remove 'mask_path'" in text
    assert "truth/" not in text
    assert "poses seem to be in OpenCV's axes" in text
    assert "Negate columns 2 and 3 of the matrix" in text
    assert "3 errors; a fit makes no sense yet" in text


@pytest.mark.parametrize(
    ("share", "told"),
    [
        (0, "0 %"),
        (0.0012, "0.12 %"),
        (0.0996, "10 %"),
        (0.123, "12 %"),
        (0.996, "100 %"),
        (1, "100 %"),
    ],
)
def test_shares_are_told_in_percent(share, told):
    assert percentage(share) == told


def test_vertex_normals_that_are_not_numbers_are_told(spoilt, unbake):
    data = spoilt("cornell")
    assert found(data.folder, "normals") == []
    scene = data.folder / data.content["scene"]
    corners, normals = np.eye(3) * 0.1, np.array([[np.nan, 0, 0], [0, 0, 1], [np.inf, 0, 0]])
    write_mesh(scene.parent / "chip.ply", corners, np.array([[0, 1, 2]]), normals)
    chip = (
        '<shape type="ply"><string name="filename" value="chip.ply"/>'
        '<bsdf type="twosided"><bsdf type="principled"/></bsdf></shape></scene>'
    )
    scene.write_text(scene.read_text().replace("</scene>", chip))
    (finding,) = found(data.folder, "normals")
    assert finding.level == "hint" and finding.what.endswith("not numbers: 2")
    assert finding.where == data.content["scene"]
    outcome = unbake("data", "check", data.folder)
    assert outcome.status == 0
    assert "hint: " in outcome.out and "geometry   hint" in outcome.out


def test_what_a_fit_leaves_out_of_rough_plastic_is_told(spoilt):
    data = spoilt("cornell")
    assert found(data.folder, "scene") == []
    scene = data.folder / data.content["scene"]
    ball = (
        '<shape type="sphere"><float name="radius" value="0.1"/><bsdf type="twosided">'
        '<bsdf type="roughplastic"><boolean name="nonlinear" value="true"/></bsdf></bsdf>'
        "</shape></scene>"
    )
    scene.write_text(scene.read_text().replace("</scene>", ball))
    (finding,) = found(data.folder, "scene")
    assert finding.level == "hint" and finding.where == data.content["scene"]
    assert finding.what == "fits make roughplastic principled, without 'nonlinear' of 1 BSDF"


def test_meshes_that_are_smooth_across_sharp_edges_are_told(spoilt):
    data = spoilt("cornell")
    scene = data.folder / data.content["scene"]
    places = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 0.5, 2]])
    faces = np.array([[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4]])
    write_mesh(scene.parent / "tent.ply", places, faces, np.tile([0.0, 0.0, 1.0], (5, 1)))
    text, tent = scene.read_text(), (
        '<shape type="ply"><string name="filename" value="tent.ply"/>{}'
        '<bsdf type="twosided"><bsdf type="principled"/></bsdf></shape></scene>'
    )  # fmt: skip
    for kind, told in (("", 1), ('<boolean name="face_normals" value="true"/>', 0)):
        scene.write_text(text.replace("</scene>", tent.format(kind)))
        hints = found(data.folder, "normals")
        assert [hint.level for hint in hints] == ["hint"] * told
        assert all("edges were round" in hint.what for hint in hints)


def test_a_scene_that_no_fit_can_use_is_told(spoilt):
    """Neither light nor a material that could be fitted, both at once."""
    data = spoilt("cornell")
    scene = data.folder / data.content["scene"]
    root = ElementTree.parse(scene).getroot()
    for child in [*root.findall("bsdf"), *root.findall("emitter")]:
        root.remove(child)
    for shape in root.findall("shape"):
        for child in [x for x in shape if x.tag in ("bsdf", "ref", "emitter")]:
            shape.remove(child)
        ElementTree.SubElement(shape, "bsdf", type="roughconductor")
    ElementTree.ElementTree(root).write(scene)
    told = {finding.what for finding in found(data.folder) if finding.level == "error"}
    assert any("no light source" in what for what in told)
    assert any("no material to fit" in what for what in told)


def test_photographs_are_read_where_the_scene_cannot_be(spoilt):
    data = spoilt("cornell")
    data.picture(data.frames[2], lambda pixels: np.full_like(pixels, np.nan))
    folder = data.save()
    (folder / data.content["scene"]).write_text("<scene")
    told = found(folder)
    assert {finding.check for finding in told} == {"scene", "files"}
    assert any("train_002" in (finding.where or "") for finding in told)


def test_every_fault_of_a_frame_is_told_before_a_fit(spoilt):
    data = spoilt("cornell")
    for i, frame in enumerate(data.frames[:5]):
        frame["file_path"] = f"images/none-{i}.exr"
    data.frames[6]["fl_x"] = -1
    with pytest.raises(UserError) as error:
        Dataset.load(data.save())
    told = str(error.value)
    assert told.count("the image does not exist") == 3
    assert told.endswith("and 3 more, all of which `unbake data check` tells")
    faults = []
    dataset = Dataset.load(data.folder, faults=faults)
    assert len(faults) == 6 and len(dataset.train) == 2
    grouped = found(data.folder, "files")
    assert len(grouped) == 2 and grouped[0].where.endswith("none-2.exr and 2 more")


@pytest.mark.parametrize("turned", [False, True])
def test_a_fit_looks_for_the_same_on_its_views(turned, spoilt):
    data = spoilt("cornell")
    if turned:
        data.poses(lambda pose: pose @ FLIP)
    else:
        for frame in data.frames[::2]:
            data.picture(frame, lambda pixels: pixels * [2, 2, 2, 1])
    dataset = Dataset.load(data.save())
    scene = parse(dataset.scene, dataset.root).instantiate()
    (finding,) = quick_findings(scene, dataset.train, Photographs.load(dataset, False))
    told = "seem to be in OpenCV's axes" if turned else "stops brighter in one than in another"
    assert told in str(finding)


def test_views_are_found_without_counting_pixels(spoilt, monkeypatch):
    """A number of NumPy is found in a range by counting: minutes for photographs of full size."""
    dataset = Dataset.load(spoilt("cornell").save())
    scene = parse(dataset.scene, dataset.root).instantiate()
    asked = []

    class Numbers:
        start = 0

        def __contains__(self, number):
            asked.append(type(number))
            return True

    photographs = Photographs.load(dataset, False)
    monkeypatch.setattr(type(photographs), "pixels", Numbers())
    quick_findings(scene, dataset.train, photographs)
    assert asked and set(asked) == {int}


@pytest.mark.slow
def test_a_fit_does_not_doubt_good_data(captured):
    for name in ("cornell", "still"):
        dataset = Dataset.load(captured(name))
        scene = parse(dataset.scene, dataset.root).instantiate()
        photographs = Photographs.load(dataset, False)
        assert quick_findings(scene, dataset.train, photographs) == []
        assert quick_findings(scene, dataset.train[:2], photographs) == []


def test_metres_for_centimetres_are_told(spoilt, unbake):
    data = spoilt("cornell")

    def metres(pose):
        pose[:3, 3] *= 0.01
        return pose

    data.poses(metres)
    outcome = unbake("data", "check", data.save())
    text = " ".join(outcome.out.split())
    assert outcome.status == 2
    assert "poses seem to be in other units" in text
    assert "Multiply positions by 100; or the mesh: import --mesh-scale 0.01" in text


def test_a_world_that_is_turned_is_told(spoilt):
    data = spoilt("cornell")
    turn = np.eye(4)
    turn[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    data.poses(lambda pose: turn @ pose)
    (finding,) = found(data.save(), "alignment")
    assert finding.level == "error" and "of a world with z up" in finding.what
    assert finding.remedy.startswith("Turn them by -90° about x: y, z become z, -y; or the mesh")


@pytest.mark.parametrize("about", ["origin", "middle"])
def test_the_matrix_that_turns_a_mesh_back_is_told(about, spoilt):
    """As an import takes it, which moves the mesh to where the cameras are."""
    data = spoilt("cornell")
    dataset = Dataset.load(data.folder)
    box = parse(dataset.scene, dataset.root).instantiate().bbox()
    middle, turn, shift = np.ravel(box.center()), np.eye(4), np.eye(4)
    turn[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    shift[:3, 3] = middle if about == "middle" else 0
    turn = shift @ turn @ np.linalg.inv(shift)
    data.poses(lambda pose: turn @ pose)
    result = check_data(data.save())
    (finding,) = [f for f in result.findings if f.check == "alignment"]
    assert finding.level == "error"
    numbers = finding.remedy.partition("import --mesh-matrix ")[2].split()
    moved = read_matrix(numbers)
    for pose, view in zip(data.frames, dataset.train, strict=True):
        back = np.linalg.inv(moved) @ np.array(pose["transform_matrix"])
        found_again = np.abs(back - view.camera.to_world).max() < 1e-4
        assert found_again or about == "origin"
    assert np.abs(moved[:3, :3] @ moved[:3, :3].T - np.eye(3)).max() < 1e-6


def test_a_mesh_with_y_up_and_in_centimetres_is_told(spoilt):
    data = spoilt("cornell")
    turn = np.eye(4)
    turn[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]

    def changed(pose):
        pose = turn @ pose
        pose[:3, 3] *= 0.01
        return pose

    data.poses(changed)
    (finding,) = found(data.save(), "alignment")
    assert "in other units and of a world with z up: " in finding.what
    told = "; or the mesh: import --mesh-scale 0.01 --mesh-y-up; if it had that already, keep it"
    assert told in finding.remedy


def test_masks_that_were_drawn_by_wrong_poses_do_not_confirm_them(spoilt):
    """Their edges are those of the mesh, wherever the camera stands."""
    data = spoilt("cornell")
    turn = np.eye(4)
    turn[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    data.poses(lambda pose: turn @ pose)
    data.content["background"] = "hidden"
    dataset = Dataset.load(data.save())
    scene = parse(dataset.scene, dataset.root).instantiate()
    (data.folder / "masks").mkdir()
    for frame, view in zip(data.frames, dataset.train, strict=True):
        (seen,) = seen_by(scene, [view.camera])
        mask = np.isfinite(seen.distance).reshape(view.camera.height, view.camera.width)
        Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).save(
            data.folder / "masks" / f"{view.name}.png"
        )
        frame |= {"mask_path": f"masks/{view.name}.png", "mask_from": "mesh"}
    folder = data.save()
    dataset = Dataset.load(folder)
    assert all(view.mask_from_mesh for view in dataset.train)
    (finding,) = found(folder, "alignment")
    assert finding.level == "error" and "of a world with z up" in finding.what
    (told,) = quick_findings(scene, dataset.train, Photographs.load(dataset, False))
    assert "of a world with z up" in told.what
    data.frames[0]["mask_from"] = "hand"
    with pytest.raises(UserError, match=r"'mask_from' is 'hand'\. It is 'mesh'"):
        Dataset.load(data.save())


@pytest.mark.parametrize("background", ["visible", "hidden"])
@pytest.mark.parametrize("some", [False, True])
def test_masks_that_leave_nothing_are_told(some, background, spoilt, unbake, tmp_path):
    data = spoilt("cornell")
    data.content["background"] = background
    size = data.frames[0]["w"], data.frames[0]["h"]
    (data.folder / "masks").mkdir()
    for i, frame in enumerate(data.frames):
        mask = Image.new("L", size, 255 if some and i else 0)
        mask.save(data.folder / "masks" / f"{i}.png")
        frame["mask_path"] = f"masks/{i}.png"
    findings = [f for f in found(data.save(), "masks") if "counts" in f.what]
    (finding,) = findings
    assert finding.level == ("warning" if some else "error")
    assert finding.where == ("train_000" if some else None)
    told = unbake("data", "check", data.folder, "--out", tmp_path / "check.html")
    assert told.status == (0 if some else 2) and (tmp_path / "check.html").is_file()
    (row,) = [line for line in told.out.splitlines() if line.strip().startswith("geometry")]
    assert "% of the pixels see a surface" in row
    assert ": 0 %" not in row


def test_what_masks_hide_is_not_seen(spoilt):
    data = spoilt("cornell")
    whole = check_data(data.save()).coverage
    mask = np.zeros((40, 40), np.uint8)
    mask[15:25, 15:25] = 255
    (data.folder / "masks").mkdir()
    Image.fromarray(mask).save(data.folder / "masks" / "middle.png")
    for frame in data.content["frames"]:
        frame["mask_path"] = "masks/middle.png"
    result = check_data(data.save())
    assert result.coverage[0] > whole[0] + 0.2
    assert any("is seen by no training view" in f.what for f in result.findings)


def test_nothing_seen_but_a_ground_is_an_error(spoilt, monkeypatch):
    data = spoilt("still")
    monkeypatch.setattr("unbake.checks.check.view_counts", lambda *_, **__: np.zeros(100, int))
    result = check_data(data.save())
    (finding,) = [f for f in result.findings if f.check == "coverage"]
    assert finding.level == "error" and not result.usable
    assert finding.what == "no training view sees anything of the scene, but a ground beneath it"
    assert "upside down" in finding.remedy


def test_masked_pixels_say_nothing_of_poses(spoilt, monkeypatch):
    """Where the background is visible, too: a fit does not learn from them either."""
    data, given = spoilt("cornell"), []
    mask = np.zeros((40, 40), np.uint8)
    mask[:, :20] = 255
    (data.folder / "masks").mkdir()
    Image.fromarray(mask).save(data.folder / "masks" / "half.png")
    for frame in data.frames:
        frame["mask_path"] = "masks/half.png"
    monkeypatch.setattr(
        "unbake.checks.check.pose_problems", lambda *words, **_: given.append(words[2]) or []
    )
    check_data(data.save())
    assert given[0].count == len(given[0].table) // 2


def test_masks_that_are_inverted_are_told(spoilt, tiny, unbake, tmp_path):
    """And not the poses, which put edges where photographs have them."""
    data = spoilt("still")
    dataset = Dataset.load(data.folder)
    data.content["background"] = "visible"
    (data.folder / "masks").mkdir()
    scene = parse(dataset.scene, dataset.root).instantiate()
    for frame, view in zip(data.content["frames"], dataset.views, strict=True):
        (seen,) = seen_by(scene, [view.camera])
        mask = ~np.isfinite(seen.distance).reshape(view.camera.height, view.camera.width)
        file = f"masks/{view.name}.png"
        Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).save(data.folder / file)
        frame["mask_path"] = file
    told = [f for f in found(data.save()) if f.check == "geometry"]
    assert told[0].what.startswith("masks seem to be inverted: 100 % of the pixels that they leave")
    assert told[0].remedy == "Masks are white where pixels count: invert them"
    assert not any("axes and the units" in (f.remedy or "") for f in told)
    words = ("--settings", tiny, "--steps", 0, "--out", tmp_path / "run")
    outcome = unbake("fit", data.folder, *words)
    assert "masks seem to be inverted" in " ".join((outcome.out + outcome.err).split())


def test_a_bracket_that_clips_has_the_exposures_that_it_tells(spoilt):
    """Most surfaces of the long photographs are at the limit."""
    data = spoilt("cornell")
    for i, frame in enumerate(data.frames):
        exposure = 8.0 if i % 2 else 0.5
        data.picture(frame, lambda pixels, e=exposure: np.minimum(e * pixels, [1, 1, 1, 99]))
        frame |= {"exposure": exposure, "clipped": 1.0}
    folder = data.save()
    assert not found(folder, "exposure")
    dataset = Dataset.load(folder)
    scene = parse(dataset.scene, dataset.root).instantiate()
    photographs = Photographs.load(dataset, False)
    assert not [
        f for f in quick_findings(scene, dataset.train, photographs) if f.check == "exposure"
    ]


@pytest.mark.parametrize("size", [(6000, 4000), (7008, 4672), (64, 1), (100, 37)])
def test_small_pictures_are_of_the_pixels_of_their_cameras(size):
    width, height = size
    camera = Camera(np.eye(4), 1.0 * width, 1.0 * width, width / 2, height / 2, width, height)
    across = np.tile((np.arange(width) + 0.5) / width, (height, 1))
    rgb = np.repeat(across.reshape(-1, 1), 3, 1).astype(np.float32)
    view = small_view("a", camera, rgb, None)
    expected = (np.arange(view.camera.width) + 0.5 - view.camera.cx) / view.camera.fl_x + 0.5
    np.testing.assert_allclose(view.rgb[0, :, 0], expected, atol=1e-4)


def test_no_other_poses_are_named_where_nothing_agrees(spoilt):
    """Noise in the place of photographs agrees with no poses."""
    data, rng = spoilt("cornell"), np.random.default_rng(0)

    def noise(pixels):
        pixels[..., :3] = rng.uniform(0.1, 0.9, pixels[..., :3].shape)
        return pixels

    for frame in data.frames:
        data.picture(frame, noise)
    assert not found(data.save(), "alignment")


def test_photographs_upside_down_are_told(spoilt):
    data = spoilt("cornell")
    for frame in data.content["frames"]:
        data.picture(frame, lambda pixels: pixels[::-1])
    (finding,) = found(data.save(), "alignment")
    assert "photographs seem to be mirrored top to bottom" in finding.what


def turned_light(folder):
    """Photographs of a grey object whose light is fixed to the camera: a turntable."""
    dataset = Dataset.load(folder)
    scene = parse(dataset.scene, dataset.root).instantiate()
    light = np.array([0.8, 0.5, 0.33])
    for view in dataset.views:
        (seen,) = seen_by(scene, [view.camera])
        normal = seen.normal @ view.camera.to_world[:3, :3]
        value = 0.1 + 0.8 * np.maximum(normal @ light, 0)
        alpha = np.isfinite(seen.distance)
        pixels = np.c_[np.repeat((value * alpha)[:, None], 3, 1), alpha]
        write_exr(view.image, pixels.reshape(view.camera.height, view.camera.width, 4))


def test_a_turntable_is_refused(spoilt, unbake):
    data = spoilt("still")
    turned_light(data.folder)
    outcome = unbake("data", "check", data.folder)
    text = " ".join(outcome.out.split())
    assert outcome.status == 2
    assert "light and shadow turn with the cameras, as where an object stands on a turn" in text
    assert "the light must stand still" in text


def test_a_fit_does_not_start_on_poses_or_light_that_are_surely_wrong(
    spoilt, tiny, unbake, tmp_path
):
    data = spoilt("cornell")
    data.poses(lambda pose: pose @ FLIP)
    words = ("fit", data.save(), "--settings", tiny, "--steps", 0, "--out")
    outcome = unbake(*words, tmp_path / "run")
    text = " ".join(outcome.err.split())
    assert outcome.status == 2 and not (tmp_path / "run").exists()
    assert "poses seem to be in OpenCV's axes" in text
    assert "Negate columns 2 and 3 of the matrix, or pass --allow-doubtful" in text
    assert text.count("error:") == 1
    outcome = unbake(*words, tmp_path / "run", "--allow-doubtful")
    assert outcome.status == 0
    assert "warning: poses seem to be in OpenCV's axes" in " ".join(outcome.out.split())


def test_a_fit_does_not_start_on_a_turntable(spoilt, tiny, unbake, tmp_path):
    data = spoilt("still")
    turned_light(data.folder)
    words = ("fit", data.folder, "--settings", tiny, "--steps", 0, "--out", tmp_path / "run")
    outcome = unbake(*words)
    assert outcome.status == 2 and not (tmp_path / "run").exists()
    assert "the light must stand still, or pass --allow-doubtful" in " ".join(outcome.err.split())
    assert unbake(*words, "--allow-doubtful").status == 0


def test_a_fit_starts_where_exposures_differ(spoilt, tiny, unbake, tmp_path):
    data = spoilt("cornell")
    for frame in data.frames[::2]:
        data.picture(frame, lambda pixels: pixels * [2, 2, 2, 1])
    words = ("--settings", tiny, "--steps", 0, "--out", tmp_path / "run")
    outcome = unbake("fit", data.save(), *words)
    assert outcome.status == 0 and "warning: surfaces that views share" in outcome.out


def test_exposures_that_differ_are_measured(spoilt):
    data = spoilt("cornell")
    stops = np.array([0.0, 1, -1, 0.5, 0, 1.5, -0.5, 0])
    for frame, stop in zip(data.frames, stops, strict=True):
        data.picture(frame, lambda p, s=stop: p * np.array([*[2.0**s] * 3, 1]))
    result = check_data(data.save())
    assert [f.check for f in result.findings if f.level == "warning"] == ["exposure"]
    assert result.usable
    train = [v.view.split == "train" for v in result.views]
    measured = result.exposures.stops[train]
    assert np.abs((measured - measured.mean()) - (stops - stops.mean())).max() < 0.15
    # Those that the data set tells are taken into account.
    for frame, stop in zip(data.frames, stops, strict=True):
        frame["exposure"] = 2.0**stop
    assert [f.check for f in found(data.save()) if f.level == "warning"] == []


def test_noise_that_was_clipped_at_black_is_told(spoilt, tiny, unbake, tmp_path):
    """Its size, before a fit and by `data check`, until the data set tells it."""
    data, rng, read = spoilt("cornell"), np.random.default_rng(0), 0.1

    def noisy(pixels):
        rgb = pixels[..., :3] + rng.normal(0, read, (*pixels.shape[:2], 3))
        return np.dstack([np.maximum(rgb, 0), pixels[..., 3]])

    for frame in data.content["frames"]:
        data.picture(frame, noisy)
    assert not [f for f in check_data(data.save()).findings if f.check == "noise"], "rendered"
    del data.content["render"]
    (finding,) = [f for f in check_data(data.save()).findings if f.check == "noise"]
    told = float(re.search(r'"read": ([0-9.]+)', finding.what)[1])
    assert finding.level == "warning" and told == pytest.approx(read, rel=0.2)
    words = ("--settings", tiny, "--steps", 1)
    outcome = unbake("fit", data.folder, "--out", tmp_path / "run", *words)
    assert outcome.status == 0 and "noise was clipped at black" in outcome.out
    data.content["noise"] = {"read": read}
    assert not [f for f in check_data(data.save()).findings if f.check == "noise"]
    outcome = unbake("fit", data.folder, "--out", tmp_path / "other", *words)
    assert outcome.status == 0 and "clipped at black" not in outcome.out


def test_clipped_black_blurred_and_double_photographs_are_told(spoilt):
    data = spoilt("cornell")
    frames = data.frames
    data.picture(frames[0], lambda p: np.minimum(p, [0.15, 0.15, 0.15, 1]))
    data.picture(frames[1], lambda p: p * [0, 0, 0, 1])
    (data.folder / frames[3]["file_path"]).write_bytes(
        (data.folder / frames[2]["file_path"]).read_bytes()
    )
    frames[5]["transform_matrix"] = frames[4]["transform_matrix"]
    # A bracket is none: photographs of one pose whose exposures differ.
    frames[6]["transform_matrix"] = frames[4]["transform_matrix"]
    frames[6]["exposure"] = 2.0
    (held,) = (f for f in data.content["frames"] if f["split"] == "heldout")
    held["transform_matrix"], held["exposure"] = frames[4]["transform_matrix"], 0.5
    warnings = {f.check: f for f in found(data.save())}
    assert "train_000" in warnings["clipped"].where
    assert "train_001" in warnings["black"].where
    doubles = found(data.folder, "duplicates")
    (split,) = (f for f in doubles if "held out" in f.what)  # one finding of a kind
    assert re.findall(r"train_\d+", split.where) == ["train_004", "train_005", "train_006"]
    assert split.remedy == "Give all of a bracket the same 'split'"
    assert {f.where: f.what for f in doubles if f is not split} == {
        "train_002 and train_003": "the photographs are the same, and their poses not",
        "train_004 and train_005": "two photographs have the same pose",
    }


def test_pairs_of_duplicates_are_counted(spoilt):
    data = spoilt("cornell")
    for frame in data.frames[1:4]:
        frame["transform_matrix"] = data.frames[0]["transform_matrix"]
    result = check_data(data.save())
    assert len([f for f in result.findings if f.check == "duplicates"]) == 1
    assert {row: told for row, _, told in told_rows(result)}["duplicates"] == "6 pairs"


def test_photographs_without_light_are_an_error(spoilt):
    data = spoilt("cornell")
    for frame in data.frames:
        data.picture(frame, lambda p: p * [0, 0, 0, 1])
    (held,) = (f for f in data.content["frames"] if f["split"] == "heldout")
    data.picture(held, lambda p: p * [0, 0, 0, 1])
    findings = found(data.save())
    (black,) = (f for f in findings if f.check == "black")
    assert (black.level, black.what) == ("error", "all photographs are black")
    assert not [f for f in findings if f.check == "duplicates"]


def test_silhouettes_are_not_black_photographs(spoilt):
    data = spoilt("cornell")

    def silhouette(picture):
        picture = picture * [0, 0, 0, 1]
        picture[0, 0] = [0.5, 0.5, 0.5, 0]
        return picture

    for frame in data.frames:
        data.picture(frame, silhouette)
    assert not [f for f in found(data.save()) if (f.check, f.level) == ("black", "error")]


def test_a_photograph_that_is_blurred_is_named():
    rng = np.random.default_rng(0)
    every = np.ones((64, 64), bool)
    facts = []
    for i in range(6):
        picture = np.exp(np.cumsum(np.cumsum(rng.normal(0, 0.02, (64, 64)), 0), 1))
        if i == 4:
            for _ in range(3):
                picture = (picture + np.roll(picture, 1, 0) + np.roll(picture, 1, 1)) / 3
        facts.append(picture_facts(np.repeat(picture[..., None], 3, 2), every, every, None))
    assert blurred(facts) == [4]
    assert blurred([PictureFacts(0, 0, None, "")] * 6) == []


def test_a_data_set_that_is_none_is_one_error(unbake, tmp_path):
    outcome = unbake("data", "check", tmp_path)
    assert outcome.status == 2
    text = " ".join(outcome.out.split())
    assert "error: " in text and "no transforms.json in the folder" in text
    assert "Traceback" not in outcome.out + outcome.err


def test_the_screen_fits_and_the_page_stands_alone(captured, unbake, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.chdir(captured("cornell").parent)
    page = tmp_path / "check.html"
    outcome = unbake("data", "check", "cornell", "--out", page)
    assert outcome.status == 0 and outcome.err == ""
    lines = outcome.out.splitlines()
    assert lines[-2] == f"wrote {page}" and lines[-1].startswith("nothing is wrong; next: ")
    assert max(map(len, [*lines[:-2], lines[-1]])) <= 80 and len(lines) <= 24
    text = page.read_text()
    assert text.count("data:image/png;base64,") == 18
    assert "http" not in text.replace("http-equiv", "") and "url(" not in text
    for word in ("Coverage", "Exposures", "Edges of the geometry", "train_007"):
        assert word in text


@pytest.mark.parametrize("cut_out", [False, True])
def test_of_poses_with_the_same_edges_those_count_that_cover_a_cut_out(cut_out, monkeypatch):
    """A floor with things on it has much the same edges from below, which hides the things."""
    rng = np.random.default_rng(0)
    pictures = rng.random((4, 32, 32))
    shown = np.zeros((32, 32), bool)
    shown[8:24] = True
    from_below = shown & (np.arange(32) < 28)
    camera = Camera.look_at((0, 0, 4), (0, 0, 0), (0, 1, 0), 40.0, 32, 32)
    alpha = shown.astype(float) if cut_out else np.ones((32, 32))
    views = [SmallView(str(i), camera, p[..., None], alpha, 0 * p) for i, p in enumerate(pictures)]
    wrong, right = Mistake(("below",)), Mistake(("above",))
    other = [rng.random((32, 32)) for _ in views]

    def drawn(scene, cameras, mistakes):
        hits = {"below": from_below, "above": shown}
        return [
            (list(pictures) if m.parts else other, [hits.get(m.told, shown)] * 4) for m in mistakes
        ]

    monkeypatch.setattr(aligning, "photograph_edges", lambda view: view.rgb[..., 0])
    monkeypatch.setattr(aligning, "drawn_edges", drawn)
    monkeypatch.setattr(aligning, "_likely", lambda scene, views: [wrong, right])
    monkeypatch.setattr(
        aligning, "_surface_seen", lambda scene, cameras, others: [1.0] * len(others)
    )
    found = aligning.alignment(None, views)
    assert found.mistake is (right if cut_out else wrong)
    assert found.best == pytest.approx(1)


def test_no_pose_that_covers_less_is_better(monkeypatch):
    """Poses that fill a cut-out are not given up for others that leave a part of it empty."""
    rng = np.random.default_rng(0)
    pictures, shown = rng.random((4, 32, 32)), np.zeros((32, 32), bool)
    shown[8:24] = True
    camera = Camera.look_at((0, 0, 4), (0, 0, 0), (0, 1, 0), 40.0, 32, 32)
    views = [
        SmallView(str(i), camera, p[..., None], shown.astype(float), 0 * p)
        for i, p in enumerate(pictures)
    ]
    other, less = [rng.random((32, 32)) for _ in views], shown & (np.arange(32) < 28)

    def drawn(scene, cameras, mistakes):
        return [
            (list(pictures) if m.parts else other, [less if m.parts else shown] * 4)
            for m in mistakes
        ]

    monkeypatch.setattr(aligning, "photograph_edges", lambda view: view.rgb[..., 0])
    monkeypatch.setattr(aligning, "drawn_edges", drawn)
    monkeypatch.setattr(aligning, "_likely", lambda scene, views: [Mistake(("turned",))])
    monkeypatch.setattr(
        aligning, "_surface_seen", lambda scene, cameras, others: [1.0] * len(others)
    )
    found = aligning.alignment(None, views)
    assert found.mistake is None and found.share == pytest.approx(0.5)


def of_a_table(turn):
    """A table of the ground's colour, which shows the ground's outline alone, z up.

    Args:
        turn: of the poses, (3, 3).

    Returns:
        The scene, and small views of it.
    """
    ground = mi.ScalarTransform4f().scale(2)
    top = mi.ScalarTransform4f().translate([0.1, 0.2, 0.7]).scale([0.6, 0.4, 0.05])
    leg = mi.ScalarTransform4f().translate([0.1, 0.2, 0.33]).scale([0.1, 0.1, 0.32])
    wood = {"type": "twosided", "sides": {"type": "principled"}}
    scene = mi.load_dict(
        {
            "type": "scene",
            "ground": {"type": "rectangle", "to_world": ground, "wood": wood},
            "top": {"type": "cube", "to_world": top, "wood": wood},
            "leg": {"type": "cube", "to_world": leg, "wood": wood},
        },
        optimize=False,  # it joins meshes
    )
    angles = np.linspace(0, 2 * np.pi, 8, endpoint=False)
    places = [(5 * np.cos(a), 5 * np.sin(a), 3 + 2 * (i % 2)) for i, a in enumerate(angles)]
    cameras = [Camera.look_at(p, (0, 0, 0.3), (0, 0, 1), 50.0, 48, 48) for p in places]
    views = []
    for i, (camera, seen) in enumerate(zip(cameras, seen_by(scene, cameras), strict=True)):
        hit = np.isfinite(seen.distance)
        shade = 0.5 * hit * np.where(seen.position[:, 2] > 0.01, 0.97, 1)
        rgb = np.repeat(shade[:, None], 3, 1).astype(np.float32)
        pose = np.eye(4)
        pose[:3, :3] = turn
        posed = replace(camera, to_world=pose @ camera.to_world)
        view = small_view(str(i), posed, rgb, hit.astype(np.float32))
        views.append(replace(view, of_mesh=True))
    return scene, views


def test_a_ground_that_hides_what_stands_on_it_is_not_taken_for_better():
    """From below its outline is all there is, as in photographs whose table is of its colour."""
    lying, over = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]), np.diag([1.0, -1, -1])
    found = {}
    for name, turn in (("right", np.eye(3)), ("lying", lying), ("under", over)):
        scene, views = of_a_table(turn)
        found[name] = aligning.alignment(scene, views)
    assert found["under"].score > found["right"].score + aligning.MARGIN, "edges alone mislead"
    assert found["right"].best is None
    for name in ("lying", "under"):
        assert found[name].best == pytest.approx(found["right"].score, abs=0.02)
        finding = misaligned(found[name])
        assert finding.level == "error"
        assert ("nearly nothing but the ground" in finding.what) == (name == "under")
    assert "of a world with y up" in misaligned(found["lying"]).what
    assert np.array_equal(found["under"].mistake.turn, over)


@pytest.mark.parametrize(("score", "unseen", "level"), [
    (0.5, False, "error"), (0.6, False, "warning"), (0.6, True, "error"),
])  # fmt: skip
def test_poses_that_most_edges_agree_with_are_not_refused(
    score, unseen, level, captured, monkeypatch
):
    """As of a courtyard that looks alike upside down; what else is wrong is told, too."""
    dataset = Dataset.load(captured("still"))
    scene = parse(dataset.scene, dataset.root).instantiate()
    photographs, turn = Photographs.load(dataset, False), Mistake(("turned (turn them)",))
    other = aligning.Alignment(8, score, 0.5, mistake=turn, best=0.8, unseen=unseen)
    finding = misaligned(other)
    assert finding.level == level
    assert finding.what.startswith("poses may be" if level == "warning" else "poses seem to be")
    assert ("whether outlines fit" in finding.remedy) == (level == "warning")
    uneven = Finding("warning", "exposure", "uneven")
    monkeypatch.setattr(quick_check, "compared", lambda *_: other)
    monkeypatch.setattr(quick_check, "unequal_exposures", lambda *_: uneven)
    told = [found.check for found in quick_findings(scene, dataset.train, photographs)]
    assert told == ["alignment", *(["exposure"] if level == "warning" else [])]


def test_a_fit_doubts_poses_by_shapes_that_are_not_merged(captured, monkeypatch):
    """A ground that is merged with what stands on it cannot be told from that."""
    dataset = Dataset.load(captured("still"))
    scene = parse(dataset.scene, dataset.root).instantiate()
    photographs, apart = Photographs.load(dataset, False), object()
    right = aligning.Alignment(8, 0.4, 0.5)
    wrong = replace(right, mistake=Mistake(("turned (turn them)",)), best=0.6)
    monkeypatch.setattr(quick_check, "compared", lambda of, *_: right if of is apart else wrong)
    words = (scene, dataset.train, photographs)
    assert [finding.check for finding in quick_findings(*words)] == ["alignment"]
    assert quick_findings(*words, lambda: apart) == []


def test_a_background_that_jpeg_made_nearly_black_hides_no_edges():
    rng = np.random.default_rng(0)
    camera = Camera.look_at((0, 0, 4), (0, 0, 0), (0, 1, 0), 40.0, 32, 32)
    shown, rgb = np.zeros((32, 32), bool), np.zeros((32, 32, 3))
    shown[12:20, 12:20] = True
    rgb[shown] = 0.5
    rgb[12:16, 12:20] = 0.25
    black = SmallView("black", camera, rgb, shown.astype(float), 0 * rgb[..., 0])
    nearly = rgb + np.where(shown, 0, 0.001 * rng.random((32, 32)))[..., None]
    ringing = replace(black, rgb=nearly)
    np.testing.assert_allclose(
        aligning.photograph_edges(ringing), aligning.photograph_edges(black), atol=0.05
    )


def test_photographs_with_the_poses_of_others_are_told(spoilt, tiny, unbake, tmp_path):
    data = spoilt("cornell")
    poses = [frame["transform_matrix"] for frame in data.frames]
    for frame, pose in zip(data.frames, [*poses[1:], poses[0]], strict=True):
        frame["transform_matrix"] = pose
    (finding,) = found(data.save(), "alignment")
    assert finding.level == "error"
    assert finding.what.startswith("poses seem not to belong to the photographs: edges of the geom")
    assert "better from the pose of another one" in finding.what
    assert finding.remedy.startswith("Check that each 'file_path' stands beside its own pose")
    words = ("--settings", tiny, "--steps", 0, "--out", tmp_path / "run")
    outcome = unbake("fit", data.folder, *words)
    assert outcome.status == 2 and "pass --allow-doubtful" in " ".join(outcome.err.split())


def test_few_photographs_with_the_poses_of_others_are_not_told(spoilt):
    """Chance may find a better pose for each of them."""
    data = spoilt("cornell")
    poses = [frame["transform_matrix"] for frame in data.frames][:5]
    frames = data.frames[:5]
    for frame, pose in zip(frames, [*poses[1:], poses[0]], strict=True):
        frame["transform_matrix"] = pose
    data.content["frames"] = frames
    assert not found(data.save(), "alignment")


def test_a_symmetric_object_on_a_turntable_is_not_told():
    """All its views look alike, so that each pose is as good as any other."""
    vase = {
        "type": "scene",
        "belly": {"type": "sphere", "radius": 0.6},
        "neck": {"type": "cylinder", "p0": [0, 0, 0], "p1": [0, 0, 1.2], "radius": 0.25},
    }
    scene = mi.load_dict(vase)
    angles = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    places = [(3 * np.cos(a), 3 * np.sin(a), 1.0) for a in angles]
    cameras = [Camera.look_at(p, (0, 0, 0.3), (0, 0, 1), 40.0, 48, 48) for p in places]
    rng, views = np.random.default_rng(0), []
    for i, (camera, seen) in enumerate(zip(cameras, seen_by(scene, cameras), strict=True)):
        shade = 0.2 + 0.5 * np.abs(seen.normal[:, 2]) + rng.normal(0, 0.01, 48 * 48)
        alpha = np.isfinite(seen.distance).astype(np.float32)
        rgb = np.repeat((shade * alpha)[:, None], 3, 1).astype(np.float32)
        views.append(small_view(str(i), camera, rgb, alpha))
    for turned in (0, 1, 5):
        posed = [replace(v, camera=cameras[i - turned]) for i, v in enumerate(views)]
        result = compared(scene, posed, cameras)
        assert result.score > 0.5 and misaligned(result) is None


@pytest.mark.parametrize("factor", [0.85, 1.15])
@pytest.mark.parametrize("name", ["cornell", "still"])
def test_wrong_focal_lengths_are_told_with_the_factor(name, factor, spoilt):
    data = spoilt(name)
    for frame in data.content["frames"]:
        frame |= {key: frame[key] * factor for key in ("fl_x", "fl_y")}
    result = check_data(data.save())
    (finding,) = [f for f in result.findings if f.check == "alignment"]
    assert finding.level == "warning" and finding.what.startswith("focal lengths seem to be wrong")
    assert result.alignment.focal == pytest.approx(1 / factor, rel=0.06)
    assert f"Multiply 'fl_x' and 'fl_y' by {result.alignment.focal:.2f}, if" in finding.remedy
    rows = {row: told for row, _, told in told_rows(result)}
    assert f"with focal lengths times {result.alignment.focal:.2f}" in rows["alignment"]


def test_mistakes_are_undone():
    rng = np.random.default_rng(0)
    camera = Camera.look_at(rng.normal(size=3), rng.normal(size=3), [0, 0, 1], 60, 8, 8)
    mistakes = all_mistakes(rng.normal(size=3))
    assert len({m.told for m in mistakes}) == len(mistakes) > 160
    for mistake in mistakes:
        corrected = mistake.corrected(camera)
        if mistake.inverted:
            wrong = np.linalg.inv(corrected.to_world @ np.diag([*np.diag(mistake.flip), 1]))
        else:
            wrong = np.eye(4)
            wrong[:3, :3] = mistake.turn.T @ corrected.to_world[:3, :3] @ mistake.flip
            away = corrected.origin - mistake.centre
            wrong[:3, 3] = mistake.centre + mistake.turn.T @ away / mistake.scale
        assert np.abs(wrong - camera.to_world).max() < 1e-9


def test_no_exposure_is_told_of_views_that_share_nothing(captured):
    dataset = Dataset.load(captured("cornell"))
    views = [small_view(v.name, v.camera, np.ones((1600, 3)), None) for v in dataset.train[:1]]
    scene = parse(dataset.scene, dataset.root).instantiate()
    points = shared_points(views, seen_by(scene, [v.camera for v in views]))
    known = exposures(points, 1)
    assert known.pairs == 0 and known.spread == 0 and turning_light(points, known) is None


def test_of_many_views_those_are_compared_that_show_the_same(captured):
    """Most of a long walk shares nothing with a view."""
    dataset = Dataset.load(captured("cornell"))
    scene = parse(dataset.scene, dataset.root).instantiate()
    inside = [view.camera for view in dataset.train][:4]
    outside = [Camera.look_at([x, 0, 90], [x, 0, 99], [0, 1, 0], 40, 40, 40) for x in range(60)]
    cameras = [*inside, *outside]
    views = [
        small_view(str(i), camera, np.full((camera.width * camera.height, 3), 1.0 + i), None)
        for i, camera in enumerate(cameras)
    ]
    seen = seen_by(scene, [view.camera for view in views])
    found = exposures(shared_points(views, seen), len(views))
    alone = exposures(shared_points(views[:4], seen[:4]), 4)
    assert min(found.pairs, alone.pairs) > len(inside)
    np.testing.assert_allclose(found.stops[:4], alone.stops, atol=1e-6)
    assert np.isnan(found.stops[4:]).all()


def test_every_check_has_a_row():
    """`Finding` takes no others, which the type checker holds."""
    rows = [check for checks in ROWS.values() for check in checks]
    assert sorted(rows) == sorted(typing.get_args(Check))


def test_more_pixels_than_a_fit_can_have_are_an_error_of_the_files(spoilt, monkeypatch):
    data = spoilt("cornell")
    data.save()
    monkeypatch.setattr("unbake.checks.check.MOST_PIXELS", 100)
    rows = {row: verdict for row, verdict, _ in told_rows(check_data(data.folder))}
    assert rows["files"] == "error"
