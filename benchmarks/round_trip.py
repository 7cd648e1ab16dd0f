"""How near exported scenes are to the fields that they were made of, as other programs read them.

    python benchmarks/round_trip.py --runs NAME=RUN [NAME=RUN ...] --work FOLDER --out FILE.json
        [--points 100000] [--views 2] [--resolution 64] [--spp 256] [--picture FILE.png]

Each run is exported with default settings, and read by programs that know nothing of unbake:
Mitsuba renders the scene, and tells the materials at points of the surface; trimesh reads the glTF
file; Khronos' validator checks it, and three.js shows it, where they are installed (see
`gltf_judges.py`). The fields are asked at the same points, and rendered with the same integrator
and seeds. Points are drawn by area of what was exported; those count that a training view saw, as
others hold values of their neighbours. A quantity agrees where it differs by 2/255 at most, albedo
as sRGB. Renderings are of training views; two pictures of either side, of different seeds, tell
their difference without the noise of their samples.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import here

import numpy as np

from unbake import backend

backend.activate()

import mitsuba as mi  # noqa: E402
import trimesh  # noqa: E402
from export_process import export_measured  # noqa: E402
from gltf_judges import browser_lacks, shown, validated, validator_lacks  # noqa: E402
from views import of_size  # noqa: E402

import unbake  # noqa: E402
from unbake.dataset.camera import Camera  # noqa: E402
from unbake.dataset.pixels import CameraRays  # noqa: E402
from unbake.exports.bake import NEAR  # noqa: E402
from unbake.exports.observed import training_views  # noqa: E402
from unbake.imaging.metrics import psnr  # noqa: E402
from unbake.imaging.pictures import encoded, tonemap, write_png  # noqa: E402
from unbake.io import read_object, write_json  # noqa: E402
from unbake.machine import machine  # noqa: E402
from unbake.quantities import QUANTITIES  # noqa: E402
from unbake.scene import free_space  # noqa: E402
from unbake.transport.render import path_integrator, render_materials  # noqa: E402

#: Of the scene's diagonal: how far above the surface rays to a point of it start.
ABOVE = 5e-4
DEPTH = 17
#: Asks a scene for its materials along rays, and renders it; knows nothing of unbake.
STOCK = """
import json, sys
import mitsuba as mi, numpy as np
told = json.loads(sys.argv[1])
mi.set_variant(told["variant"])
scene = mi.load_file(told["scene"])
with np.load(told["rays"]) as rays:
    ray = mi.Ray3f(mi.Point3f(rays["o"].T), mi.Vector3f(rays["d"].T))
si = scene.ray_intersect(ray)
bsdf, hit = si.bsdf(), si.is_valid()
found = {"distance": np.where(np.array(hit), np.array(si.t), np.inf)}
for name, (slot, channels) in told["slots"].items():
    ask = bsdf.eval_attribute_3 if channels == 3 else bsdf.eval_attribute_1
    known = bsdf.has_attribute(slot, hit)
    value = np.atleast_2d(np.array(ask(slot, si, hit & known))).T
    found[name] = np.where(np.array(known)[:, None], value, np.nan)
integrator = mi.load_dict(told["integrator"])
for i, sensor in enumerate(told["sensors"]):
    sensor["to_world"] = mi.ScalarTransform4f(np.array(sensor["to_world"]))
    camera = mi.load_dict(sensor)
    for seed in told["seeds"]:
        image = mi.render(scene, sensor=camera, integrator=integrator, spp=told["spp"], seed=seed)
        found[f"picture_{i}_{seed}"] = np.array(image)[..., :3]
np.savez(told["out"], **found)
assert not [name for name in sys.modules if name.startswith("unbake")]
"""


def main() -> None:
    """Measure each run, and write the result after it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--runs", nargs="+", required=True, help="NAME=RUN, folders of fits")
    parser.add_argument("--work", type=Path, required=True, help="folder of exports")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to write")
    parser.add_argument("--points", type=int, default=100_000)
    parser.add_argument("--views", type=int, default=2)
    parser.add_argument("--resolution", type=int, default=64)
    parser.add_argument("--spp", type=int, default=256, help="samples a pixel of each picture")
    parser.add_argument("--picture", type=Path, help="the first run in a browser, beside unbake")
    args = parser.parse_args()
    args.work.mkdir(parents=True, exist_ok=True)
    found: dict[str, Any] = {"machine": machine(), "runs": {}}
    found |= {key: getattr(args, key) for key in ("points", "views", "resolution", "spp")}
    for given in args.runs:
        name, _, run = given.partition("=")
        row = measure(unbake.Run(run), args.work.resolve() / name, args)
        found["runs"][name] = row
        args.picture = None
        write_json(args.out, found, allow_nan=False)
        print(f"{name}: {json.dumps(row)}", flush=True)


def measure(run: unbake.Run, work: Path, args: argparse.Namespace) -> dict[str, Any]:
    """What programs find in the export of a run."""
    work.mkdir(exist_ok=True)
    out, cost_file = work / "export", work / "cost.json"
    if not out.exists():
        cost = export_measured(run.path, out, "--format", "gltf", "mitsuba", "textures")
        write_json(cost_file, cost)
    manifest = read_object(out / "export.json")
    points = Points(run, out / "scene.glb", args.points)
    pictures = [run.cameras("train")[i] for i in range(args.views)]
    pictures = [of_size(camera, args.resolution) for camera in pictures]
    stock = by_mitsuba(run, out, points, pictures, args.spp)
    rows = manifest["materials"]
    return {
        "data": photographed(run),
        "steps": manifest["run"]["steps"],
        "parts": len(manifest["parts"]),
        "triangles": sum(part["triangles"] for part in manifest["parts"]),
        "materials": len(rows),
        "texels_per_unit": manifest["texels_per_unit"],
        "megatexels": sum(row["resolution"] ** 2 for row in rows) / 1e6,
        "resolutions": sorted(row["resolution"] for row in rows),
        "density": density(out / "scene.glb", manifest["texels_per_unit"]),
        "told_near": manifest["near"],
        "unobserved_share": manifest["unobserved_share"],
        "cost": read_object(cost_file),
        "glb_mb": round((out / "scene.glb").stat().st_size / 1e6, 1),
        "points": int(points.counted.sum()),
        "mitsuba": points.shares(stock),
        "gltf": points.shares(points.in_file),
        "renderings": rendered_alike(run, pictures, stock, args.spp),
        "validator": judged(out / "scene.glb"),
        "browser": in_browser(run, out / "scene.glb", args.picture),
    }


def photographed(run: unbake.Run) -> dict[str, int]:
    """The photographs of a run."""
    cameras = run.cameras("train")
    return {"train": len(cameras), "width": cameras[0].width, "height": cameras[0].height}


# ------------------------------------------------------------------------------- at surface points


def textured(file: Path) -> list[Any]:
    """The meshes of a glTF file that have textures."""
    loaded = trimesh.load(file)
    assert isinstance(loaded, trimesh.Scene)
    shapes = loaded.geometry.values()
    return [s for s in shapes if s.visual.material.baseColorTexture is not None]


def density(file: Path, pixels_per_unit: float) -> dict[str, float]:
    """Texels along the width of a pixel on the surface: mean over the area, least and most."""
    shapes = textured(file)
    areas = np.array([shape.area for shape in shapes])
    found = []
    for shape, area in zip(shapes, areas, strict=True):
        a, b, c = np.moveaxis(shape.visual.uv[shape.faces], 1, 0)
        (x, y), (z, w) = (b - a).T, (c - a).T
        in_uv = np.abs(x * w - y * z).sum() / 2
        width = shape.visual.material.baseColorTexture.size[0]
        found.append(width * np.sqrt(in_uv / area) / pixels_per_unit)
    mean = float(np.average(found, weights=areas))
    return {"mean": mean, "least": float(min(found)), "most": float(max(found))}


class Points:
    """Points of what was exported, and what the fields and the glTF file have there.

    Args:
        run: of a fit.
        file: the glTF file.
        count: of points; those that no training view saw do not count.
    """

    def __init__(self, run: unbake.Run, file: Path, count: int) -> None:
        shapes = textured(file)
        areas = np.array([shape.area for shape in shapes])
        counts = np.random.default_rng(0).multinomial(count, areas / areas.sum())
        where, normals, two_sided, found = [], [], [], []
        for shape, n in zip(shapes, counts, strict=True):
            if n == 0:
                continue
            at, faces = trimesh.sample.sample_surface(shape, int(n), seed=1)
            where.append(at)
            normals.append(shape.face_normals[faces])
            two_sided.append(np.full(n, bool(shape.visual.material.doubleSided)))
            found.append(_in_file(shape, at, faces))
        self.in_file = {k: np.concatenate([each[k] for each in found]) for k in found[0]}
        scene = run.scene
        self._above = ABOVE * free_space.bounds(scene)[2]
        normal = np.concatenate(normals)
        self.o = (np.concatenate(where) + self._above * normal).astype(np.float32)
        self.d = -normal.astype(np.float32)
        self.fields = run.material_along(self.o, self.d)
        si = scene.ray_intersect(mi.Ray3f(mi.Point3f(self.o.T), mi.Vector3f(self.d.T)))
        views = training_views(run.recovered)
        sides = mi.Bool(np.concatenate(two_sided))
        seen = views.see(mi.Point3f(si.p), mi.Normal3f(normal.T), sides, si.is_valid())
        self.counted = self.fields["seen"] & np.array(seen) & self.on_surface(np.array(si.t))

    def on_surface(self, distance: np.ndarray) -> np.ndarray:
        """Whether rays end at their points, and not at something else, (n,) bool."""
        return np.abs(distance - self._above) < 0.5 * self._above

    def shares(self, found: dict[str, np.ndarray]) -> dict[str, float]:
        """Of the points that count, those where a quantity is that of the fields, by quantity."""
        counted = self.counted
        if "distance" in found:
            counted = counted & self.on_surface(found["distance"])
        shares = {}
        for name, quantity in QUANTITIES.items():
            if name not in self.fields:
                continue
            a, b = (x[name].reshape(len(x[name]), -1) for x in (found, self.fields))
            if quantity.display == "colour":
                a, b = encoded(a), encoded(b)
            off = np.abs(a - b).max(1)[counted]
            shares[name] = float((off <= NEAR).mean())
            shares[f"{name}_median"] = float(255 * np.median(off))
        return shares


def _in_file(shape: Any, at: np.ndarray, faces: np.ndarray) -> dict[str, np.ndarray]:
    """Quantities at points of a mesh as a glTF file has them, linear."""
    weights = trimesh.triangles.points_to_barycentric(shape.triangles[faces], at)
    uv = np.einsum("nk,nkd->nd", weights, shape.visual.uv[shape.faces[faces]])
    uv[:, 1] = 1 - uv[:, 1]  # trimesh counts v from the last row
    material = shape.visual.material
    stored = _looked_up(material.baseColorTexture.convert("RGB"), uv)
    linear = np.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)
    both = _looked_up(material.metallicRoughnessTexture.convert("RGB"), uv)
    return {"albedo": linear, "roughness": both[:, 1], "metallic": both[:, 2]}


def _looked_up(image: Any, uv: np.ndarray) -> np.ndarray:
    """Bilinear values of a picture, (n, 3) in [0, 1]; (0, 0) is the corner of its first texel."""
    pixels = np.asarray(image, np.float32) / 255
    height, width = pixels.shape[:2]
    at = np.clip(uv * [width, height] - 0.5, 0, [width - 1.00001, height - 1.00001])
    x, y = at.astype(int).T
    fx, fy = (at - at.astype(int)).T[..., None]
    top = pixels[y, x] * (1 - fx) + pixels[y, x + 1] * fx
    return top * (1 - fy) + (pixels[y + 1, x] * (1 - fx) + pixels[y + 1, x + 1] * fx) * fy


# ------------------------------------------------------------------------- by Mitsuba, and pictures


def by_mitsuba(
    run: unbake.Run, out: Path, points: Points, cameras: list[Camera], spp: int
) -> dict[str, np.ndarray]:
    """Materials at points, and pictures, of the exported scene by Mitsuba alone."""
    rays, result = out.parent / "rays.npz", out.parent / "stock.npz"
    np.savez(rays, o=points.o, d=points.d)
    sensors = [dict(camera.sensor(spp)) for camera in cameras]
    for sensor in sensors:
        sensor["to_world"] = np.array(sensor["to_world"].matrix).tolist()
    told = {
        "variant": mi.variant(),
        "scene": str((out / "mitsuba" / "scene.xml").resolve()),
        "rays": str(rays),
        "slots": {
            name: (QUANTITIES[name].slot, QUANTITIES[name].channels)
            for name in points.fields
            if name in QUANTITIES
        },
        "integrator": integrator_of(run),
        "sensors": sensors,
        "spp": spp,
        "seeds": [0, 1],
        "out": str(result),
    }
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    words = [sys.executable, "-c", STOCK, json.dumps(told)]
    subprocess.run(words, env=environment, cwd=out, check=True)
    with np.load(result) as file:
        return dict(file)


def integrator_of(run: unbake.Run) -> dict[str, Any]:
    """The integrator of both sides."""
    return {"type": path_integrator(run.scene), "max_depth": DEPTH, "rr_depth": DEPTH}


def rendered_alike(
    run: unbake.Run, cameras: list[Camera], stock: dict[str, np.ndarray], spp: int
) -> list[dict[str, float]]:
    """PSNR in dB of pictures of the exported scene against those of the fields, view by view.

    `psnr`: of means of two pictures. `same_fields_psnr`: of two pictures of the fields, which is
    noise alone. `noise_free_least`: of the product of the differences of two pairs, which have
    nothing in common but what the scenes differ in, two standard errors over pixels added to it.
    """
    integrator = mi.load_dict(integrator_of(run))
    rows = []
    for i, camera in enumerate(cameras):
        sensor = mi.load_dict(camera.sensor(spp))
        own = [
            np.array(mi.render(run.scene, sensor=sensor, integrator=integrator, spp=spp, seed=s))
            for s in (0, 1)
        ]
        a, b = (x[..., :3].clip(0, 1) for x in own)
        c, d = (stock[f"picture_{i}_{seed}"].clip(0, 1) for seed in (0, 1))
        # Pictures of one seed may share noise: the two factors have different seeds.
        product = ((a - c) * (b - d)).mean(-1)
        most = max(product.mean(), 0) + 2 * product.std() / np.sqrt(product.size)
        rows.append(
            {
                "psnr": psnr((c + d) / 2, (a + b) / 2),
                "same_fields_psnr": psnr(a, b),
                "noise_free_least": -10 * float(np.log10(most)),
            }
        )
    return rows


# ------------------------------------------------------------------------------- judges of the file


def judged(file: Path) -> dict[str, Any]:
    """What the validator says, or why it cannot."""
    lacks = validator_lacks()
    if lacks is not None:
        return {"not_run": lacks}
    report = validated(file)
    codes = sorted({message["code"] for message in report["messages"]})
    counts = {key: report[f"num{key.capitalize()}"] for key in ("errors", "warnings", "infos")}
    return {"version": report["version"], **counts, "codes": codes}


def in_browser(run: unbake.Run, file: Path, picture: Path | None) -> dict[str, Any]:
    """How near the file in a browser is to the base colour that unbake sees, or why it is not told.

    Args:
        picture: where both are written side by side; None: nowhere.
    """
    lacks = browser_lacks()
    if lacks is not None:
        return {"not_run": lacks}
    camera = of_size(run.cameras("train")[0], 512)
    there = shown(file, camera)
    scene_view, rays = run.recovered.problem.scene_view, CameraRays.of([camera])
    values, coverage = render_materials(scene_view, rays.through, rays.pixels, 16, seed=0)
    seen = tonemap(values["albedo"].reshape(camera.height, camera.width, 3))
    known = coverage.reshape(camera.height, camera.width) > 0.999
    if picture is not None:
        gap = np.full((camera.height, 16, 3), 255, np.uint8)
        write_png(picture, np.concatenate([seen, gap, there], 1))
    return {"psnr": psnr(there / 255, seen / 255, known), "pixels": int(known.sum())}


if __name__ == "__main__":
    main()
