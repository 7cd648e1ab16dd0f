"""What cameras do to photographs is done as told, the same for the same seed, with its truth."""

import json
import re
import shutil
from typing import get_args

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from support import globe

from unbake.acquisition.decimate import decimated
from unbake.acquisition.degrade import degrade, displacement, response
from unbake.acquisition.settings import DegradeSettings, Response
from unbake.dataset.lighting import true_emission
from unbake.dataset.views import Dataset, SensorNoise, read_masked
from unbake.errors import UserError
from unbake.evaluation.evaluate import require_true_materials
from unbake.evaluation.placing import told_of_place
from unbake.imaging.pictures import read_exr, write_exr
from unbake.imaging.srgb import from_srgb, to_srgb
from unbake.io import read_json
from unbake.scene.emitters import named_emitters
from unbake.scene.parse import parse


@pytest.fixture
def degraded(cornell, tmp_path):
    """`degraded(**faults)`: a degraded copy of the room, its data set and the truth beside it."""
    number = iter(range(100))

    def make(**faults):
        out = tmp_path / f"degraded-{next(number)}"
        dataset = degrade(cornell, out, DegradeSettings(**faults), tell=lambda line: None)
        return dataset, read_json(out / "degraded.json")

    return make


def test_a_degraded_data_set_is_not_degraded_again(degraded, tmp_path):
    dataset, _ = degraded(exposure=1.0)
    with pytest.raises(UserError, match="degraded already"):
        degrade(dataset.folder, tmp_path / "twice", DegradeSettings(), tell=lambda line: None)
    assert not (tmp_path / "twice").exists()


def pictures(dataset):
    return {view.name: read_exr(view.image) for view in dataset.views}


def test_without_faults_a_copy_is_the_same(cornell, degraded):
    dataset, truth = degraded()
    before = Dataset.load(cornell)
    assert truth["gain"] == 1 and truth["clipped"] is None
    for old, new in zip(before.views, dataset.views, strict=True):
        assert np.array_equal(read_exr(old.image), read_exr(new.image))
        assert np.array_equal(old.camera.to_world, new.camera.to_world)
        assert {k: read_exr(f).tolist() for k, f in old.truth.items()} == {
            k: read_exr(f).tolist() for k, f in new.truth.items()
        }
    assert dataset.kind == before.kind and dataset.light_by_depth == before.light_by_depth


def test_exposure_balance_and_vignetting_are_those_of_the_truth(cornell, degraded):
    dataset, truth = degraded(exposure=1.5, white_balance=0.5, vignetting=0.4, seed=3)
    clean = pictures(Dataset.load(cornell))
    for name, pixels in pictures(dataset).items():
        told = truth["views"][name]
        y, x = (np.indices((16, 16)) + 0.5) / 16 - 0.5
        falls = 1 - 0.4 * (x**2 + y**2) / 0.5
        factor = told["exposure"] * np.array(told["white_balance"]) * falls[..., None]
        np.testing.assert_allclose(pixels[..., :3], clean[name][..., :3] * factor, rtol=1e-5)
    assert truth["views"]["train_000"]["exposure"] == 1
    stops = np.log2([view["exposure"] for view in truth["views"].values()])
    assert np.abs(stops).max() <= 1.5 and np.ptp(stops) > 0.1


def test_the_same_seed_gives_the_same_and_each_fault_its_own_numbers(degraded):
    faults = {"exposure": 1.0, "electrons": 500.0, "read_noise": 5.0, "pose_jitter": 1.0}
    (one, first), (two, second) = degraded(**faults), degraded(**faults)
    assert first == second
    for a, b in zip(pictures(one).values(), pictures(two).values(), strict=True):
        assert np.array_equal(a, b)
    _, other = degraded(**faults, seed=1)
    assert other["views"] != first["views"]
    _, alone = degraded(exposure=1.0)
    ratio = [
        first["views"][name]["exposure"] / alone["views"][name]["exposure"]
        for name in first["views"]
    ]
    np.testing.assert_allclose(ratio, first["gain"])


def test_a_response_is_kept_as_a_table_and_ends_at_white(cornell, degraded):
    dataset, truth = degraded(response="contrast", clip=0.1)
    clean = pictures(Dataset.load(cornell))
    table = truth["response"]
    values = np.concatenate([p[..., :3].ravel() for p in pictures(dataset).values()])
    assert values.max() == 1
    for name, pixels in pictures(dataset).items():
        linear = np.minimum(clean[name][..., :3] * truth["gain"], 1)
        read = np.interp(linear, table["linear"], table["read"])
        np.testing.assert_allclose(pixels[..., :3], read, atol=2e-4)
    assert {view.clipped for view in dataset.views} == {1}
    assert {view.exposure for view in dataset.views} == {truth["gain"]}


@pytest.mark.parametrize("kind", get_args(Response))
def test_responses_rise_from_black_to_white(kind):
    values = response(np.linspace(0, 1, 101), kind)
    assert values[0] == 0 and abs(values[-1] - 1) < 1e-12 and (np.diff(values) > 0).all()


def test_a_lifted_response_has_another_middle_than_the_curve_of_a_fit():
    middle = from_srgb(np.array([0.5]))
    assert to_srgb(response(middle, "lifted")) == pytest.approx(0.65)
    assert to_srgb(response(middle, "contrast")) == pytest.approx(0.5)


def test_noise_has_the_variance_of_its_electrons(cornell, degraded):
    dataset, truth = degraded(electrons=200.0, read_noise=4.0, clip=0.0)
    clean = pictures(Dataset.load(cornell))
    error, variance = [], []
    for name, pixels in pictures(dataset).items():
        linear = clean[name][..., :3].astype(float) * truth["gain"]
        inside = (linear > 0.2) & (linear < 0.7)
        error.append((pixels[..., :3] - linear)[inside])
        variance.append(linear[inside] / 200 + (4 / 200) ** 2)
    error, variance = np.concatenate(error), np.concatenate(variance)
    assert len(error) > 300
    assert abs((error**2 / variance).mean() - 1) < 4 * np.sqrt(2 / len(error))


def test_poses_are_off_by_pixels_and_the_true_ones_are_kept(cornell, degraded):
    before = {view.name: view.camera for view in Dataset.load(cornell).views}
    scene = parse(Dataset.load(cornell).scene).instantiate()
    for pixels in (0.3, 3.0):
        dataset, truth = degraded(pose_jitter=pixels)
        squares = []
        for view in dataset.views:
            given = before[view.name]
            kept = np.array(truth["views"][view.name]["transform_matrix"])
            assert np.array_equal(kept, given.to_world)
            place = told_of_place(scene, given, view.camera)
            assert place["degrees"] > 0 and place["shift"] > 0 and place["pixels"] < 3 * pixels
            squares.append(place["pixels"] ** 2)
        assert np.sqrt(np.mean(squares)) == pytest.approx(pixels, rel=0.1)


def test_meshes_are_displaced_by_smooth_noise(cornell, degraded):
    dataset, truth = degraded(displace=0.01)
    assert truth["displaced"]["meshes"]
    with pytest.raises(UserError, match="are not those of the photographs"):
        require_true_materials(dataset)
    old = parse(Dataset.load(cornell).scene).instantiate()
    new = parse(dataset.scene).instantiate()
    assert len(old.shapes()) == len(new.shapes())
    assert not np.allclose(np.array(old.bbox().max), np.array(new.bbox().max))
    points = np.random.default_rng(0).uniform(-1, 1, (4000, 3))
    moved = displacement(points, DegradeSettings(displace=0.01), 2.0)
    assert 0.5 < np.sqrt((moved**2).sum(1).mean()) / 0.02 < 2
    near = displacement(points + 1e-4, DegradeSettings(displace=0.01), 2.0)
    assert np.abs(near - moved).max() < 2e-3


def test_lamps_of_changed_meshes_keep_the_names_of_their_true_strengths(cornell, degraded):
    dataset, truth = degraded(displace=0.01)
    names = [emitter.name for emitter in named_emitters(parse(dataset.scene))]
    assert names == [emitter.name for emitter in named_emitters(parse(Dataset.load(cornell).scene))]
    assert names and set(names) == set(true_emission(dataset.folder))
    assert any(file.endswith(f"/{names[0]}.ply") for file in truth["displaced"]["meshes"])


def test_a_mesh_that_cannot_be_written_is_told_and_nothing_is_left(cornell, tmp_path, monkeypatch):
    def full(mesh, path):
        raise RuntimeError("No space left on device")

    monkeypatch.setattr(mi.Mesh, "write_ply", full)
    out = tmp_path / "degraded"
    with pytest.raises(UserError, match="the mesh cannot be written"):
        degrade(cornell, out, DegradeSettings(displace=0.01), tell=lambda line: None)
    assert not out.exists()


def test_large_meshes_lose_triangles(cornell, degraded, monkeypatch):
    pytest.importorskip("pycolmap", reason="fewer triangles need pycolmap")
    few = mi.traverse(decimated([globe(32, 16)], 0.1)[0])
    assert len(few["faces"]) // 3 == pytest.approx(102, abs=10)
    points, normals = (
        np.array(few[name]).reshape(-1, 3) for name in ("vertex_positions", "vertex_normals")
    )
    assert np.linalg.norm(points, axis=1) == pytest.approx(1, abs=0.06)
    assert (points * normals).sum(1) == pytest.approx(1, abs=0.08), "smooth"
    # In a data set, whose boxes are otherwise too small
    monkeypatch.setattr("unbake.acquisition.degrade.FEWEST", 10)
    dataset, truth = degraded(decimate=0.5)
    counts = [
        sum(shape.face_count() for shape in parse(d.scene).instantiate().shapes())
        for d in (Dataset.load(cornell), dataset)
    ]
    # Two boxes of ten triangles, beside walls
    assert counts[0] - counts[1] == pytest.approx(10, abs=3)
    assert truth["triangles"] == 0.5 and len(truth["displaced"]["meshes"]) == 6
    assert dataset.has_true_materials, "nothing in this room has a texture"


def window(segments):
    """A square wall with a round window: positions and faces."""
    angles = np.linspace(0, 2 * np.pi, segments, endpoint=False)
    circle = np.stack([np.cos(angles), np.sin(angles), 0 * angles], -1)
    square = circle / np.abs(circle).max(-1, keepdims=True) * 2
    i, j = np.arange(segments), np.roll(np.arange(segments), -1)
    faces = [np.stack([i, i + segments, j], -1), np.stack([j, i + segments, j + segments], -1)]
    return np.concatenate([circle, square]) + np.array([0, 0, 5]), np.concatenate(faces)


def test_meshes_lose_triangles_where_they_are_dense():
    pytest.importorskip("pycolmap", reason="fewer triangles need pycolmap")
    wall, ball = window(64), globe(128, 64)
    few = decimated([wall, ball], 0.1)
    before, after = ([len(mesh[1]) for mesh in (wall, ball)], [m.face_count() for m in few])
    assert sum(after) == pytest.approx(0.1 * sum(before), rel=0.05)
    assert after[0] > 0.3 * before[0], "the round window stays round"
    areas = [float(np.sum(mesh.surface_area())) for mesh in few]
    assert areas[0] == pytest.approx(16 - np.pi, rel=0.01)
    assert areas[1] == pytest.approx(4 * np.pi, rel=0.02)
    alone = decimated([wall], 0.1)[0]
    assert alone.face_count() < 20
    assert abs(float(np.sum(alone.surface_area())) - (16 - np.pi)) > 0.16


@pytest.mark.parametrize("share", [0.001, 0.01, 0.02])
@pytest.mark.parametrize("count", [1, 20])
def test_the_smallest_shares_leave_something_of_each_mesh(share, count):
    pytest.importorskip("pycolmap", reason="fewer triangles need pycolmap")
    positions, faces = globe(6, 7)
    few = decimated([(positions + np.array([3 * i, 0, 0]), faces) for i in range(count)], share)
    assert len(few) == count
    assert all(1 <= mesh.face_count() < len(faces) / 2 for mesh in few)


def test_small_things_beside_large_ones_stay_solid():
    """They are smaller than what the rest of the scene is off by."""
    pytest.importorskip("pycolmap", reason="fewer triangles need pycolmap")
    x, y = np.mgrid[:61, :61] / 10
    height = 0.1 * np.random.default_rng(0).uniform(size=x.size)
    floor = np.stack([x.ravel(), y.ravel(), height], -1)
    i = np.arange(61 * 60).reshape(60, 61)[:, :-1].ravel()
    faces = np.concatenate(
        [np.stack([i, i + 61, i + 1], -1), np.stack([i + 1, i + 61, i + 62], -1)]
    )
    positions, ball = globe(12, 7)
    sizes = (0.05, 0.02, 0.01, 0.005)
    small = [(positions * r + [k, 0, 1], ball) for k, r in enumerate(sizes)]
    for mesh, r in zip(decimated([(floor, faces), *small], 0.1)[1:], sizes, strict=True):
        assert mesh.face_count() < len(ball) / 2
        assert float(np.sum(mesh.surface_area())) > 0.5 * 4 * np.pi * r**2


def test_open_rims_leave_triangles_to_the_rest():
    """The foot of a dish has as many edges as its rim, and nobody sees it."""
    pytest.importorskip("pycolmap", reason="fewer triangles need pycolmap")
    heights, radii = (np.array(x) for x in ([0, 0.02, 0.1, 0.2], [0.1, 0.12, 0.3, 0.4]))
    angles = np.linspace(0, 2 * np.pi, 48, endpoint=False)
    rings = [
        np.stack([r * np.cos(angles), r * np.sin(angles), np.full(48, h)], -1)
        for h, r in zip(heights, radii, strict=True)
    ]
    i = np.arange(48)
    j, faces = np.roll(i, -1), []
    for k in range(3):
        low, high = 48 * k, 48 * (k + 1)
        faces += [np.stack([i + low, j + low, i + high], -1)]
        faces += [np.stack([j + low, j + high, i + high], -1)]
    dish = np.concatenate(rings), np.concatenate(faces)
    few = decimated([dish, globe(32, 16)], 0.1)[0]
    size = few.bbox().extents()
    assert min(size[0], size[1]) > 0.9 * 0.8


PAINTS = {
    "bitmap": '<string name="filename" value="paint.exr"/>',
    "checkerboard": '<rgb name="color0" value="0.2 0.5 0.4"/>',
    "mesh_attribute": '<string name="name" value="vertex_color"/>',
}


@pytest.mark.parametrize("paint", PAINTS)
def test_textures_are_lost_with_the_coordinates_of_decimated_meshes(
    paint, cornell, tmp_path, monkeypatch
):
    pytest.importorskip("pycolmap", reason="fewer triangles need pycolmap")
    monkeypatch.setattr("unbake.acquisition.degrade.FEWEST", 10)
    data = shutil.copytree(cornell, tmp_path / "data")
    write_exr(Dataset.load(data).scene.parent / "paint.exr", np.full((4, 4, 3), 0.5, np.float32))
    scene = Dataset.load(data).scene
    text, said = scene.read_text(), []
    colour = text.index("<rgb", text.index("principled"))
    end = text.index("/>", colour) + 2
    name = re.search(r'name="(\w+)"', text[colour:end])[1]
    texture = f'<texture type="{paint}" name="{name}">{PAINTS[paint]}</texture>'
    scene.write_text(text[:colour] + texture + text[end:])
    for file in scene.parent.rglob("*.ply"):
        mesh = mi.load_dict({"type": "ply", "filename": str(file)})
        mesh.add_attribute("vertex_color", 3, [0.5] * 3 * mesh.vertex_count())
        mesh.write_ply(str(file))
    assert Dataset.load(data).has_true_materials
    few = degrade(data, tmp_path / "few", DegradeSettings(decimate=0.5), tell=said.append)
    assert not few.has_true_materials and "no longer has its true materials" in " ".join(said)
    kinds = {node.props.plugin_name() for node in parse(few.scene, few.root).state.nodes}
    assert (paint in kinds) == (paint != "mesh_attribute")  # a fit would miss what meshes have lost
    with pytest.raises(UserError, match="does not hold its true materials"):
        require_true_materials(few)


def test_noise_that_is_told_is_that_of_photographs(degraded):
    """Squares of errors, in units of the variance that the data set tells."""
    noisy, _ = degraded(electrons=200.0, read_noise=4.0, exposure=1.0, tell_noise=True)
    clean, _ = degraded(clip=0.01, exposure=1.0)
    for one, other in zip(noisy.views, clean.views, strict=True):
        assert one.noise == SensorNoise(1 / 200, 4 / 200) and other.noise is None
        found, true = (read_masked(v)[0][..., :3].astype(float) for v in (one, other))
        # Neither clipped, nor so dark that noise is cut off below zero.
        known = (true > 0.15) & (true < 0.7)
        errors = (found - true)[known] ** 2 / one.noise.variance(true[known])
        assert errors.mean() == pytest.approx(1, abs=0.1)
    for settings in ({}, {"electrons": 200.0, "response": "gamma"}):
        with pytest.raises(UserError, match="tell_noise"):
            DegradeSettings(tell_noise=True, **settings)


def test_options_of_another_format_are_refused(cornell, unbake, tmp_path):
    outcome = unbake("degrade", cornell, "-o", tmp_path / "out", "--format", "png", "--quality", 50)
    assert outcome.status == 2 and "--quality: needs --format jpeg" in outcome.err
    assert not (tmp_path / "out").exists()


def test_the_command_says_where_it_wrote(cornell, unbake, tmp_path):
    out = tmp_path / "out"
    outcome = unbake("degrade", cornell, "-o", out, "--exposure", 1, "--tell-exposures")
    assert outcome.status == 0, outcome
    assert f"wrote {out}; next: unbake data check {out}" in outcome.out
    content, truth = (
        json.loads((out / f"{n}.json").read_text()) for n in ("transforms", "degraded")
    )
    told = [frame.get("exposure", 1) for frame in content["frames"]]
    assert told == [view["exposure"] for view in truth["views"].values()]
    again = unbake("degrade", cornell, "--out", out)
    assert again.status == 2 and "the folder is not empty" in again.err
    assert list(tmp_path.iterdir()) == [out]


@pytest.mark.parametrize(("kind", "error"), [("png", 0.3), ("jpeg", 6)])
def test_photographs_of_8_bits_are_read_as_they_were(kind, error, degraded):
    coded, truth = degraded(format=kind, exposure=1.0)
    plain, _ = degraded(clip=0.01, exposure=1.0)
    assert {view.encoding for view in coded.views} == {"srgb"}
    assert truth["gain"] != 1
    for one, other in zip(coded.views, plain.views, strict=True):
        assert one.image.suffix == (".png" if kind == "png" else ".jpg")
        assert one.exposure == other.exposure
        assert one.clipped == 1 if kind == "png" else 0.95 < one.clipped < 1
        read, linear = (read_masked(view)[0][..., :3] for view in (one, other))
        codes = [255 * to_srgb(np.asarray(x, np.float64)) for x in (read, linear)]
        assert np.abs(codes[0] - codes[1]).mean() < error


def test_colour_of_a_jpeg_has_half_the_resolution_or_all_of_it(degraded):
    plain, _ = degraded(format="png")

    def lost(chroma):
        """Of differences between channels, root mean square in code values."""
        found, coded = [], degraded(format="jpeg", chroma=chroma, quality=100)[0]
        for one, other in zip(coded.views, plain.views, strict=True):
            read = [read_masked(view)[0][..., :3].astype(np.float64) for view in (one, other)]
            codes = [255 * to_srgb(pixels) for pixels in read]
            found.append(np.diff(codes[0] - codes[1], axis=2))
        return np.sqrt(np.mean(np.square(found)))

    assert lost("full") < 0.5 * lost("half")


def test_a_jpeg_has_a_mask_where_the_background_is_hidden(cornell, tmp_path):
    data = shutil.copytree(cornell, tmp_path / "data")
    content = json.loads((data / "transforms.json").read_text())
    (data / "transforms.json").write_text(json.dumps(content | {"background": "hidden"}))
    file = data / "images" / "train_000.exr"
    pixels = read_exr(file)
    pixels[:4] = 0
    pixels[4] *= 0.5  # half covered, and premultiplied
    write_exr(file, pixels)
    out = tmp_path / "out"
    dataset = degrade(data, out, DegradeSettings(format="jpeg"), tell=lambda line: None)
    counted = read_masked(next(v for v in dataset.views if v.name == "train_000"))[1]
    assert not counted[:4].any() and np.array_equal(counted[4:], pixels[4:, :, 3] > 0)
    dataset = degrade(data, tmp_path / "png", DegradeSettings(format="png"), tell=lambda line: None)
    assert all(view.mask is None for view in dataset.views)
    view = next(v for v in dataset.views if v.name == "train_000")
    read = read_masked(view)[0]
    assert (read[:4] == 0).all()
    shown = (view.exposure * pixels[4, :, :3]).clip(max=0.5)
    np.testing.assert_allclose(read[4, :, :3], shown, atol=0.01)


def test_white_is_told_by_pixels_that_count(cornell, tmp_path):
    data = shutil.copytree(cornell, tmp_path / "data")
    content = json.loads((data / "transforms.json").read_text())
    mask = np.full((16, 16), 255, np.uint8)
    mask[:4] = 0
    (data / "masks").mkdir()
    Image.fromarray(mask).save(data / "masks" / "upper.png")
    brightest = []
    for frame in content["frames"]:
        frame["mask_path"] = "masks/upper.png"
        pixels = read_exr(data / frame["file_path"])
        pixels[:4, :, :3] = 500
        write_exr(data / frame["file_path"], pixels)
        if frame["split"] == "train":
            brightest.append(pixels[4:, :, :3].max())
    (data / "transforms.json").write_text(json.dumps(content))
    degrade(data, tmp_path / "out", DegradeSettings(clip=0.0), tell=lambda line: None)
    gain = read_json(tmp_path / "out" / "degraded.json")["gain"]
    assert gain == pytest.approx(1 / max(brightest), rel=1e-5)


@pytest.mark.parametrize("told", [{"clipped": 1.0}, {"noise": {"shot": 0.01, "read": 0.0}}])
def test_photographs_of_a_camera_are_not_degraded(told, cornell, tmp_path):
    """What they tell of it would no longer be true."""
    data = shutil.copytree(cornell, tmp_path / "data")
    content = json.loads((data / "transforms.json").read_text())
    for frame in content["frames"]:
        frame |= told
    (data / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(UserError, match="of a camera already"):
        degrade(data, tmp_path / "out", DegradeSettings(), tell=lambda line: None)


def test_changed_meshes_are_written_once(cornell, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    dataset = degrade(cornell, "worse", DegradeSettings(displace=0.01), tell=lambda line: None)
    truth = json.loads((tmp_path / "worse" / "degraded.json").read_text())
    folder = dataset.scene.resolve().parent
    meshes = {file.relative_to(folder).as_posix() for file in folder.rglob("changed-*/*.ply")}
    assert meshes == set(truth["displaced"]["meshes"]) and meshes
    text = (tmp_path / dataset.scene).read_text()
    assert all(name in text for name in meshes)


def test_read_noise_needs_electrons():
    with pytest.raises(UserError, match="needs electrons"):
        DegradeSettings(read_noise=3.0)
