"""Data sets in the layouts of other programs, and the comparison with what was captured."""

import json
import math

import numpy as np
import trimesh
from PIL import Image

from unbake.dataset.views import Dataset, read_photograph
from unbake.imaging.coded import encode
from unbake.imaging.pictures import write_exr

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


def write_nerfstudio(captured, folder):
    """One `transforms.json`, whose cameras have been moved."""
    frames = []
    for view in captured.views:
        save(codes(view), folder / "images" / f"{view.name}.png")
        pose = (APPLIED @ view.camera.to_world).tolist()
        frames.append({"file_path": f"./images/{view.name}.png", "transform_matrix": pose})
    top = intrinsics(captured.views[0].camera) | {"camera_model": "OPENCV", "k1": 0.0, "p2": 0}
    lists = {"train_filenames": [], "test_filenames": []}
    for view in captured.views:
        key = "train_filenames" if view.split == "train" else "test_filenames"
        lists[key].append(f"./images/{view.name}.png")
    applied = {"applied_transform": APPLIED[:3].tolist(), "ply_file_path": "sparse_pc.ply"}
    write_json(folder / "transforms.json", top | applied | lists | {"frames": frames})


def write_blender(captured, folder, least_alpha=254):
    """A file for each split, names without suffix, and alpha, which is the least in a corner."""
    angle = horizontal_angle(captured.views[0].camera)
    for split, short in (("train", "train"), ("heldout", "test"), ("heldout", "val")):
        frames = []
        for view in captured.views:
            if view.split != split:
                continue
            alpha = np.full((*codes(view).shape[:2], 1), 255, np.uint8)
            alpha[0, 0] = least_alpha
            save(np.concatenate([codes(view), alpha], 2), folder / short / f"{view.name}.png")
            pose = view.camera.to_world.tolist()
            frames.append({"file_path": f"./{short}/{view.name}", "transform_matrix": pose})
        write_json(folder / f"transforms_{short}.json", {"camera_angle_x": angle, "frames": frames})


def write_colmap(captured, folder):
    """A project with a text model, written without pycolmap."""
    (folder / "sparse" / "0").mkdir(parents=True)
    lens = captured.views[0].camera
    size, focal = f"{lens.width} {lens.height}", f"{lens.fl_x!r} {lens.cx!r} {lens.cy!r}"
    model = {"cameras": f"1 SIMPLE_PINHOLE {size} {focal}\n", "points3D": "", "images": ""}
    for number, view in enumerate(captured.views, 1):
        save(codes(view), folder / "images" / f"{view.name}.png")
        matrix = np.linalg.inv(view.camera.to_world @ np.diag([1.0, -1, -1, 1]))
        x, y, z, w = quaternion(matrix[:3, :3])
        numbers = " ".join(repr(float(v)) for v in (w, x, y, z, *matrix[:3, 3]))
        model["images"] += f"{number} {numbers} 1 {view.name}.png\n\n"
    for name, content in model.items():
        (folder / "sparse" / "0" / f"{name}.txt").write_text(content)


def write_photographed_room(captured, meshes, folder):
    """A room of FIPT with `cam.txt` and `K_list.txt`, its photographs also as 8-bit ones."""
    write_mesh(meshes, folder)
    poses, lenses = [str(len(captured.views))], [str(len(captured.views))]
    for number, view in enumerate(captured.views):
        camera = view.camera
        _, up, back, origin = camera.to_world[:3].T
        poses += [" ".join(map(repr, row.tolist())) for row in (origin, origin - 2 * back, up)]
        lenses += [f"{camera.fl_x!r} 0 {camera.cx!r}", f"0 {camera.fl_y!r} {camera.cy!r}", "0 0 1"]
        (folder / "Image").mkdir(exist_ok=True)
        write_exr(folder / "Image" / f"{number:03d}_0001.exr", read_photograph(view))
        save(codes(view), folder / "ldr" / f"{number:03d}_0001.png")
    (folder / "cam.txt").write_text("\n".join(poses) + "\n")
    (folder / "K_list.txt").write_text("\n".join(lenses))


def write_rendered_room(captured, meshes, folder):
    """A room of FIPT with `train` and `val`."""
    write_mesh(meshes, folder)
    for name, views in (("train", captured.train), ("val", captured.heldout)):
        frames = []
        (folder / name / "Image").mkdir(parents=True)
        for number, view in enumerate(views):
            # x to the left, y up, z forwards
            left, up, forwards = -view.camera.to_world[:, 0], *(view.camera.to_world[:, [1, 2]].T)
            pose = np.stack([left, up, -forwards, view.camera.to_world[:, 3]], 1)
            frames.append({"transform_matrix": pose.tolist()})
            image = folder / name / "Image" / f"{number:03d}_0001.exr"
            write_exr(image, read_photograph(view)[..., :3])
        top = {"camera_angle_x": horizontal_angle(views[0].camera)}
        write_json(folder / name / "transforms.json", top | {"frames": frames})


def write_mesh(meshes, folder):
    folder.mkdir()
    parts = [trimesh.load_mesh(mesh) for mesh in meshes]
    trimesh.util.concatenate(parts).export(folder / "scene.obj")


def horizontal_angle(camera):
    """Of view, in radians."""
    return 2 * math.atan(0.5 * camera.width / camera.fl_x)


def quaternion(rotation):
    """(x, y, z, w) of a rotation, by its axis and angle."""
    values, vectors = np.linalg.eig(rotation)
    axis = np.real(vectors[:, np.argmin(np.abs(values - 1))])
    cos = np.clip((np.trace(rotation) - 1) / 2, -1, 1)
    skew = rotation - rotation.T
    angle = np.arccos(cos) * (1 if axis @ (skew[2, 1], skew[0, 2], skew[1, 0]) >= 0 else -1)
    return (*(axis * np.sin(angle / 2)), np.cos(angle / 2))


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
