"""What `unbake export` writes agrees with what was recovered, read by other programs."""

import json
import os
import re
import runpy
import shutil
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from xml.etree import ElementTree

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import trimesh
from PIL import Image
from support import random_values, tiny_fields, with_more

import unbake
from unbake.dataset.camera import Camera, LookAt
from unbake.dataset.pixels import CameraRays
from unbake.dataset.views import Dataset, View
from unbake.errors import UserError
from unbake.exports import export as exporting
from unbake.exports import gltf
from unbake.exports.bake import (
    WANTED,
    Baker,
    bake_texture,
    look_up,
    own_opacities,
    own_textures,
)
from unbake.exports.cameras import Shot
from unbake.exports.constants import Constants, material_constants
from unbake.exports.gltf import Document, write_glb
from unbake.exports.lights import Light, environment_picture, read_lights
from unbake.exports.mitsuba import write_scene
from unbake.exports.observed import Views, filled, training_views
from unbake.exports.parts import parsed_principled, read_parts
from unbake.exports.tessellate import Triangles
from unbake.exports.textures import file_names
from unbake.exports.unwrap import make_atlases, unique_share
from unbake.exports.upright import Up
from unbake.exports.usd import write_usd
from unbake.imaging.metrics import psnr
from unbake.imaging.pictures import read_exr, tonemap, write_exr, write_png
from unbake.quantities import QUANTITIES
from unbake.scene.parse import parse
from unbake.scene.triangles import write_mesh
from unbake.training.loop import fit
from unbake.training.problem import make_problem
from unbake.training.recovered import Recovered, load_run
from unbake.transport.render import render_materials

#: A floor with two sides, a pillar and a ball of one material, two meshes of one name, a group that
#: stands at two places, glass, and lights of three kinds.
SCENE = """<scene version="3.0.0">
  <integrator type="path"/>
  <sensor type="perspective"><float name="fov" value="60"/>
    <transform name="to_world">
      <lookat origin="0.5,-2.6,2.2" target="0,0,0.3" up="0,0,1"/></transform>
    <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/>
      <rfilter type="box"/></film></sensor>
  <bsdf type="twosided" id="Floor"><bsdf type="principled" id="floor/paint">
    <texture type="bitmap" name="metallic"><string name="filename" value="metal.exr"/>
      <boolean name="raw" value="true"/></texture></bsdf></bsdf>
  <bsdf type="diffuse" id="stone"/>
  <bsdf type="principled" id="cloth"/>
  <bsdf type="dielectric" id="glass"/>
  <shape type="rectangle" id="ground"><ref id="Floor"/>
    <transform name="to_world"><scale x="1.5" y="1.2"/></transform></shape>
  <shape type="sphere" id="ball"><ref id="stone"/><float name="radius" value="0.3"/>
    <point name="center" x="-0.7" y="0.2" z="0.5"/></shape>
  <shape type="sphere" id="shell"><ref id="stone"/><float name="radius" value="0.2"/>
    <boolean name="flip_normals" value="true"/>
    <point name="center" x="-0.7" y="-0.7" z="0.5"/></shape>
  <shape type="cylinder" id="pillar"><ref id="stone"/><float name="radius" value="0.15"/>
    <point name="p0" x="0.8" y="0.6" z="0.02"/><point name="p1" x="0.8" y="0.6" z="0.9"/></shape>
  <shape type="ply"><string name="filename" value="a/part.ply"/><ref id="cloth"/></shape>
  <shape type="ply"><string name="filename" value="b/part.ply"/><ref id="cloth"/></shape>
  <shape type="shapegroup" id="stack"><shape type="cube" id="block"><ref id="cloth"/>
    <transform name="to_world"><scale value="0.12"/></transform></shape></shape>
  <shape type="instance"><ref id="stack"/><transform name="to_world">
    <translate x="0.2" y="-0.6" z="0.2"/></transform></shape>
  <shape type="instance"><ref id="stack"/><transform name="to_world">
    <scale x="-1"/><translate x="0.7" y="-0.6" z="0.2"/></transform></shape>
  <shape type="sphere" id="lens"><ref id="glass"/><float name="radius" value="0.1"/>
    <point name="center" x="0" y="-0.9" z="0.2"/></shape>
  <shape type="disk" id="lamp"><emitter type="area"><rgb name="radiance" value="6 4 2"/></emitter>
    <transform name="to_world"><scale value="0.3"/><rotate x="1" angle="180"/>
      <translate z="1.6"/></transform></shape>
  <emitter type="spot" id="torch"><rgb name="intensity" value="1 2 4"/>
    <transform name="to_world"><lookat origin="1,-1,1.5" target="0,0,0" up="0,0,1"/></transform>
  </emitter>
  <emitter type="constant"><rgb name="radiance" value="0.5"/></emitter>
</scene>
"""


def triangle(*corners, extra=()):
    """A mesh of one triangle, and triangles of these corners."""
    faces = np.array([[0, 1, 2], *extra], np.uint32)
    return Triangles(np.array(corners, np.float32), faces, None, None)


@dataclass(frozen=True)
class Exported:
    """A run, what was read of it, and a folder of an export as if all had been seen."""

    run: Path
    recovered: Recovered
    folder: Path
    manifest: dict

    def use(self, monkeypatch):
        """Have exports read the random fields."""
        monkeypatch.setattr(exporting, "load_run", lambda *_, **__: self.recovered)


@pytest.fixture(scope="module")
def mixed(tmp_path_factory) -> Path:
    """The file of the scene."""
    folder = tmp_path_factory.mktemp("mixed")
    rng = np.random.default_rng(3)
    write_exr(folder / "metal.exr", rng.random((4, 4)))
    # Without texture coordinates; the second one with a triangle that has no area.
    first = triangle((-1, 0.9, 0.3), (0, 0.9, 0.3), (-0.5, 0.9, 1))
    write_mesh(folder / "a" / "part.ply", *first.arrays)
    bent = triangle((0, 1, 0.3), (0.6, 1, 0.3), (0.3, 0.9, 1), extra=[(0, 1, 1)])
    write_mesh(folder / "b" / "part.ply", *bent.arrays)
    (folder / "scene.xml").write_text(SCENE)
    return folder / "scene.xml"


def grey_data(scene, folder) -> Path:
    """A data set of two views of a scene, all grey: nothing is learned from them here."""
    shutil.copytree(scene.parent, folder)
    views = []
    for i, origin in enumerate([(0.5, -2.6, 2.2), (-1.8, -1.5, 1.8)]):
        camera = LookAt(origin, (0, 0, 0.3), (0, 0, 1), 60.0).camera(16, 16)
        write_exr(folder / f"view_{i}.exr", np.full((16, 16, 4), (0.4, 0.4, 0.4, 1), np.float32))
        views.append(View(f"view_{i}", "train", camera, folder / f"view_{i}.exr", {}))
    Dataset(folder, folder / scene.name, "visible", tuple(views), {}, None).save(folder)
    return folder


@pytest.fixture(scope="module")
def data(mixed, tmp_path_factory) -> Path:
    """A data set of the scene."""
    return grey_data(mixed, tmp_path_factory.mktemp("seen") / "data")


def as_if_seen(patch):
    """Have exports take every point as seen."""
    patch.setattr(Views, "see", lambda self, p, n, two_sided, active: active & mi.Bool(True))


@pytest.fixture(scope="module")
def exported(data, tmp_path_factory) -> Exported:
    """All formats, with texels enough for the fields, and as if every point had been seen."""
    folder = tmp_path_factory.mktemp("exported")
    run = folder / "run"
    config = replace(tiny_fields("grid"), method="direct", unknown="materials+lighting", steps=0)
    config = replace(config, lighting=replace(config.lighting, resolution=8, coarse_gain=1.0))
    fit(data, run, config)
    recovered = load_run(run)
    problem = recovered.problem
    assert problem.materials is not None and problem.environment is not None
    problem.materials.assign(random_values(problem.materials, 1))
    problem.environment.assign(random_values(problem.environment, 1, 0.4))
    problem.environment.prepare()
    problem.materials.stand_alone()  # with the new parameters
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exporting, "load_run", lambda *_, **__: recovered)
        as_if_seen(patch)
        formats = ("gltf", "textures", "mitsuba", "usd")
        out, silent = folder / "out", {"tell": lambda line: None}
        manifest = exporting.export(run, out, formats, texels=60.0, **silent)
    return Exported(run, recovered, out, manifest)


def material_at(recovered, points):
    """The recovered quantities at world positions (n, 3)."""
    si = dr.zeros(mi.SurfaceInteraction3f, len(points))
    si.p = mi.Point3f(np.ascontiguousarray(np.asarray(points).T, np.float32))
    found = recovered.problem.materials.evaluate(si, dr.ones(mi.Bool, len(points)))
    return {name: np.array(value).T for name, value in found.items()}


def srgb(linear):
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def looked_up(image, uv):
    """Bilinear values of a picture at (n, 2) coordinates of glTF: (0, 0) is the first texel."""
    pixels = np.asarray(image, np.float64)
    n = len(pixels)
    at = np.clip(uv * n - 0.5, 0, n - 1.000001)
    (x, y), (fx, fy) = at.astype(int).T, (at - at.astype(int)).T[..., None]
    top = pixels[y, x] * (1 - fx) + pixels[y, x + 1] * fx
    return top * (1 - fy) + (pixels[y + 1, x] * (1 - fx) + pixels[y + 1, x + 1] * fx) * fy


# ---------------------------------------------------------------------------------------- the parts


def test_parts_keep_names_and_places(mixed):
    found = read_parts(mixed, mixed.parent)
    parts = {part.name: part for part in found.parts}
    assert list(parts) == ["ground", "ball", "shell", "pillar", "part", "part-2", "block",
                           "block-2", "lens", "lamp"]  # fmt: skip
    assert [name for name, part in parts.items() if not part.is_optimized] == ["lens", "lamp"]
    assert parts["ground"].two_sided and not parts["ball"].two_sided
    assert parts["part-2"].dropped == 1 and len(parts["part-2"].triangles.faces) == 1
    assert not parts["ball"].exact and parts["ground"].exact


#: Two groups, of one shape and of two, and instances of them with and without ids.
PLACED = """<scene version="3.0.0">
  <shape type="shapegroup" id="seat"><shape type="rectangle" id="cushion"/></shape>
  <shape type="shapegroup" id="set"><shape type="cube" id="plate"/>
    <shape type="rectangle" id="cup"/></shape>
  <shape type="instance" id="armchair"><ref id="seat"/></shape>
  <shape type="instance"><ref id="seat"/></shape>
  <shape type="instance" id="for guests"><ref id="set"/></shape>
  <shape type="instance"><ref id="set"/></shape>
  <emitter type="constant"/></scene>"""


def test_instances_have_their_own_names(tmp_path):
    (tmp_path / "scene.xml").write_text(PLACED)
    names = {part.name for part in read_parts(tmp_path / "scene.xml", tmp_path).parts}
    assert names == {"armchair", "cushion", "for guests/plate", "for guests/cup", "plate", "cup"}


def test_parts_are_where_mitsuba_has_them(mixed, tmp_path):
    """Distance, normals of both kinds and texture coordinates, of flipped and mirrored ones too."""
    original = parsed_principled(mixed, mixed.parent).instantiate(merge=False)
    scene = {"type": "scene"}
    for i, part in enumerate(read_parts(mixed, mixed.parent).parts):
        write_mesh(tmp_path / f"{i}.ply", *part.triangles.arrays)
        flat = part.triangles.normals is None
        ply = {"type": "ply", "filename": str(tmp_path / f"{i}.ply"), "face_normals": flat}
        scene[f"shape{i}"] = ply
    rng = np.random.default_rng(0)
    origins = rng.normal(0, 1, (3, 20_000))
    origins *= 3 / np.linalg.norm(origins, axis=0)
    d = rng.normal(0, 0.5, origins.shape) - origins
    d /= np.linalg.norm(d, axis=0)
    ray = mi.Ray3f(mi.Point3f(origins.astype(np.float32)), mi.Vector3f(d.astype(np.float32)))
    a, b = original.ray_intersect(ray), mi.load_dict(scene).ray_intersect(ray)
    both = np.array(a.is_valid()) & np.array(b.is_valid())
    assert both.sum() > 5000 and (np.array(a.is_valid()) == np.array(b.is_valid())).mean() > 0.998
    for near, x, y in (
        (5e-3, a.t, b.t), (0.1, a.n, b.n), (0.01, a.sh_frame.n, b.sh_frame.n), (2e-3, a.uv, b.uv)
    ):  # fmt: skip
        x, y = (np.atleast_2d(np.array(each))[:, both] for each in (x, y))
        error = np.abs(x - y).max(0)
        # Meshes without coordinates have Mitsuba's, which are those of each triangle.
        assert (error < near).mean() > 0.99


@pytest.mark.parametrize("kind", ["sphere", "cylinder", "disk", "rectangle", "cube"])
@pytest.mark.parametrize("flipped", ["false", "true"])
@pytest.mark.parametrize("scale", [1, -1])
def test_shapes_without_a_file_keep_their_sides(kind, flipped, scale, tmp_path):
    file = tmp_path / "scene.xml"
    file.write_text(
        f'<scene version="3.0.0"><shape type="{kind}"><bsdf type="principled"/>'
        f'<boolean name="flip_normals" value="{flipped}"/><transform name="to_world">'
        f'<scale x="{scale}" y="1" z="1"/><rotate x="1" angle="40"/></transform></shape>'
        "</scene>"
    )
    original = parsed_principled(file, tmp_path).instantiate(merge=False)
    (part,) = read_parts(file, tmp_path).parts
    write_mesh(tmp_path / "part.ply", *part.triangles.arrays)
    flat = part.triangles.normals is None
    ply = {"type": "ply", "filename": str(tmp_path / "part.ply"), "face_normals": flat}
    rng = np.random.default_rng(0)
    origins = rng.normal(0, 1, (3, 4000))
    origins *= 5 / np.linalg.norm(origins, axis=0)
    d = rng.uniform(-0.5, 0.5, origins.shape) - origins
    d /= np.linalg.norm(d, axis=0)
    ray = mi.Ray3f(mi.Point3f(origins.astype(np.float32)), mi.Vector3f(d.astype(np.float32)))
    copy = mi.load_dict({"type": "scene", "a": ply})
    a, b = original.ray_intersect(ray), copy.ray_intersect(ray)
    dr.eval(a, b)
    both = np.array(a.is_valid()) & np.array(b.is_valid())
    assert both.sum() > 200
    for shaded in (b.n, b.sh_frame.n):  # triangles are wound to the side that is shaded
        assert (np.array(dr.dot(a.sh_frame.n, shaded))[both] > 0.9).mean() > 0.97


def test_meshes_are_wound_to_the_side_that_they_are_shaded_on(tmp_path):
    """A scale below zero turns triangles, and not their normals."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    ball.vertex_normals  # noqa: B018 - computes them, so that they are written
    ball.export(tmp_path / "ball.ply", vertex_normal=True)
    mirrored = '<transform name="to_world"><scale x="-1"/></transform>'
    for place in ("", mirrored):
        (tmp_path / "scene.xml").write_text(
            f"""<scene version="3.0.0"><shape type="ply">{place}
              <string name="filename" value="ball.ply"/><bsdf type="diffuse"/></shape>
              <emitter type="constant"/></scene>"""
        )
        (part,) = read_parts(tmp_path / "scene.xml", tmp_path).parts
        triangles = part.triangles
        a, b, c = (triangles.positions[corner] for corner in triangles.faces.T)
        outward = (np.cross(b - a, c - a) * (a + b + c)).sum(1) > 0
        assert triangles.normals is not None and outward.all()


# --------------------------------------------------------------------------- what others read of it


def test_what_was_written_is_told(exported):
    manifest = json.loads((exported.folder / "export.json").read_text())
    assert manifest == json.loads(json.dumps(exported.manifest))
    written = {p.relative_to(exported.folder).as_posix() for p in exported.folder.rglob("*.*")}
    assert set(manifest["files"]) | {"export.json"} == written
    materials = {row["name"]: row for row in manifest["materials"]}
    assert {name: row["coordinates"] for name, row in materials.items()} == {
        "floor/paint": "own", "stone": "uvunwrap", "cloth": "uvunwrap"
    }  # fmt: skip
    assert all(row["unique_share"] >= 0.999 for row in materials.values())
    assert manifest["learned"] == ["albedo", "roughness"]
    assert not list(exported.folder.parent.glob(".*"))


def gltf_near(exported, folder):
    """Shares of points where a glTF file has the fields' albedo and roughness; metallic there."""
    loaded, found = trimesh.load(folder / "scene.glb"), {}
    for name, geometry in loaded.geometry.items():
        material = geometry.visual.material
        if not material.baseColorTexture:
            continue
        points, faces = trimesh.sample.sample_surface(geometry, 500, seed=1)
        weights = trimesh.triangles.points_to_barycentric(geometry.triangles[faces], points)
        uv = np.einsum("nk,nkd->nd", weights, geometry.visual.uv[geometry.faces[faces]])
        uv[:, 1] = 1 - uv[:, 1]  # trimesh counts v from the last row
        truth = material_at(exported.recovered, points)
        colour = looked_up(material.baseColorTexture.convert("RGB"), uv)
        both = looked_up(material.metallicRoughnessTexture.convert("RGB"), uv)
        close = np.abs(colour - 255 * srgb(truth["albedo"])).max(1) <= 2
        rough = np.abs(both[:, 1] - 255 * truth["roughness"]) <= 2
        found[name] = close.mean(), rough.mean(), both[:, 2], material
    return found


#: A scene that says nothing of cameras.
WITHOUT_SENSOR = """<scene version="3.0.0">
  <shape type="rectangle"><bsdf type="diffuse"/></shape><emitter type="constant"/></scene>"""


@pytest.mark.parametrize("aspect", [1.0, 1.01])
def test_a_scene_without_a_sensor_gets_that_of_the_first_photograph(aspect, tmp_path):
    (tmp_path / "scene.xml").write_text(WITHOUT_SENSOR)
    wanted = replace(LookAt((0, 0, 3), (0, 0, 0), (0, 1, 0), 40).camera(64, 48), cx=35.0, cy=21.0)
    wanted = replace(wanted, fl_y=aspect * wanted.fl_x)
    (tmp_path / "out").mkdir()
    scene, scratch = (parsed_principled(tmp_path / "scene.xml", tmp_path) for _ in range(2))
    made = write_scene(tmp_path / "out", scene, scratch, [], [], [], None, wanted)
    (sensor,) = mi.load_file(str(made.path)).sensors()
    assert sensor.sampler().sample_count() == 64
    found = Camera.from_mitsuba(sensor)
    assert [found.cx, found.cy, found.width, found.height] == pytest.approx([35, 21, 64, 48])
    np.testing.assert_allclose(found.to_world, wanted.to_world, atol=1e-5)
    assert found.fl_x == pytest.approx((1 + aspect) / 2 * wanted.fl_x, rel=1e-5)
    assert ["mean of two focal lengths" in note for note in made.notes] == [True] * (aspect != 1)


def test_a_scene_without_an_integrator_gets_one(tmp_path):
    (tmp_path / "scene.xml").write_text(WITHOUT_SENSOR)
    (tmp_path / "out").mkdir()
    scene, scratch = (parsed_principled(tmp_path / "scene.xml", tmp_path) for _ in range(2))
    camera = LookAt((0, 0, 3), (0, 0, 0), (0, 1, 0), 40).camera(4, 4)
    made = write_scene(tmp_path / "out", scene, scratch, [], [], [], None, camera)
    assert np.array(mi.render(mi.load_file(str(made.path)), spp=1)).shape[:2] == (4, 4)
    # A scene keeps its own
    own = made.path.read_text().replace('type="path"', 'type="direct"')
    assert own.count("<integrator") == 1
    (tmp_path / "own.xml").write_text(own)
    (tmp_path / "again").mkdir()
    scene, scratch = (parsed_principled(tmp_path / "own.xml", tmp_path) for _ in range(2))
    made = write_scene(tmp_path / "again", scene, scratch, [], [], [], None, camera)
    assert re.findall(r'<integrator .*type="(\w+)"', made.path.read_text()) == ["direct"]


def test_a_gltf_file_that_would_be_too_large_is_told(monkeypatch):
    document = Document()
    document.view(bytes(1000))
    assert len(b"".join(document.content())) > 1000
    monkeypatch.setattr(gltf, "LARGEST", 999)
    with pytest.raises(UserError, match=r"would have .* GiB, glTF has at most 4") as caught:
        document.content()
    assert "--texels" in caught.value.remedy


def test_gltf_has_the_recovered_materials(exported):
    found = gltf_near(exported, exported.folder)
    told = {part["name"]: part["material"] for part in exported.manifest["parts"]}
    assert {name: material.name for name, (*_, material) in found.items()} == {
        name: material for name, material in told.items() if material
    }
    for name, (albedo, roughness, metallic, material) in found.items():
        assert albedo > 0.98 and roughness > 0.98, name
        own = np.ptp(metallic) > 100 if told[name] == "floor/paint" else metallic.max() == 0
        assert own, "metallic is that of the scene"
        assert material.doubleSided == (name == "ground")


@pytest.fixture(scope="module")
def with_metallic(data, tmp_path_factory) -> Exported:
    """An export of a run that learned metallic, too."""
    folder = tmp_path_factory.mktemp("metallic")
    config = replace(tiny_fields("grid"), method="direct", steps=0)
    config = replace(config, quantities=("albedo", "roughness", "metallic"))
    fit(data, folder / "run", config)
    recovered = load_run(folder / "run")
    materials = recovered.problem.materials
    materials.assign(random_values(materials, 1))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exporting, "load_run", lambda *_, **__: recovered)
        as_if_seen(patch)
        words = {"texels": 60.0, "tell": lambda line: None}
        formats = ("gltf", "textures")
        manifest = exporting.export(folder / "run", folder / "out", formats, **words)
    return Exported(folder / "run", recovered, folder / "out", manifest)


def test_learned_metallic_is_in_gltf_and_in_textures(with_metallic):
    """Within 2/255 of the field, at points of each part, and not that of the scene."""
    made = with_metallic
    assert made.manifest["learned"] == ["albedo", "roughness", "metallic"]
    materials = {row["name"]: row for row in made.manifest["materials"]}
    loaded = trimesh.load(made.folder / "scene.glb")
    tried = 0
    for name, geometry in loaded.geometry.items():
        material = geometry.visual.material
        if not material.baseColorTexture:
            continue
        points, faces = trimesh.sample.sample_surface(geometry, 500, seed=2)
        weights = trimesh.triangles.points_to_barycentric(geometry.triangles[faces], points)
        uv = np.einsum("nk,nkd->nd", weights, geometry.visual.uv[geometry.faces[faces]])
        uv[:, 1] = 1 - uv[:, 1]
        truth = 255 * material_at(made.recovered, points)["metallic"]
        blue = looked_up(material.metallicRoughnessTexture.convert("RGB"), uv)[:, 2]
        files = materials[material.name]["textures"]
        stems = [made.folder / "textures" / file for file in files if "_metallic." in file]
        exr, png = sorted(stems, key=lambda file: file.suffix)
        linear = 255 * looked_up(read_exr(exr)[..., :1], uv)[:, 0]
        stored = np.array(mi.Bitmap(str(png)))
        stored = looked_up(stored.reshape(*stored.shape[:2], -1), uv)[:, 0]
        for found in (blue, linear, stored):
            assert (np.abs(found - truth) <= 2).mean() > WANTED, name
        tried += np.ptp(truth) > 20
    assert tried > 3


def test_a_benchmark_compares_learned_metallic(with_metallic, repository, monkeypatch):
    monkeypatch.syspath_prepend(str(repository / "benchmarks"))
    points = runpy.run_path(str(repository / "benchmarks" / "round_trip.py"))["Points"]
    run = unbake.Run(with_metallic.run)
    run.recovered = with_metallic.recovered
    made = points(run, with_metallic.folder / "scene.glb", 2000)
    assert made.shares(made.in_file)["metallic"] > 0.95
    wrong = made.in_file | {"metallic": 0 * made.in_file["metallic"]}
    assert made.shares(wrong)["metallic"] < 0.5


@pytest.fixture(scope="module")
def judges(repository):
    """`benchmarks/gltf_judges.py`."""
    return runpy.run_path(str(repository / "benchmarks" / "gltf_judges.py"))


def test_khronos_finds_nothing_wrong_with_gltf(exported, judges, tmp_path):
    lacks = judges["validator_lacks"]()
    if lacks is not None:
        pytest.skip(lacks)
    report = judges["validated"](exported.folder / "scene.glb")
    assert report["numErrors"] == report["numWarnings"] == 0, report["messages"]
    broken = (exported.folder / "scene.glb").read_bytes()
    (tmp_path / "broken.glb").write_bytes(broken.replace(b'"VEC3"', b'"VEC2"'))
    assert judges["validated"](tmp_path / "broken.glb")["numErrors"] > 0


def test_a_browser_shows_the_recovered_colours(exported, judges):
    lacks = judges["browser_lacks"]()
    if lacks is not None:
        pytest.skip(lacks)
    camera = exported.recovered.dataset.train[0].camera.rescaled(256, 256)
    there = judges["shown"](exported.folder / "scene.glb", camera)
    scene_view, rays = exported.recovered.problem.scene_view, CameraRays.of([camera])
    values, coverage = render_materials(scene_view, rays.through, rays.pixels, 4, seed=0)
    here = tonemap(values["albedo"].reshape(256, 256, 3))
    known = coverage.reshape(256, 256) > 0.99
    assert known.mean() > 0.3 and np.ptp(here[known]) > 50
    # Not at edges, and not where glass stands in front: it is drawn as solid there.
    assert np.percentile(np.abs(there[known] - 1.0 * here[known]), 90) <= 3


def test_a_browser_says_what_it_cannot_show(judges, tmp_path):
    lacks = judges["browser_lacks"]()
    if lacks is not None:
        pytest.skip(lacks)
    (tmp_path / "broken.glb").write_bytes(b"no glTF")
    camera = LookAt((0, 0, 4), (0, 0, 0), (0, 1, 0), 60).camera(16, 16)
    with pytest.raises(RuntimeError, match="not valid JSON"):
        judges["shown"](tmp_path / "broken.glb", camera)


def document_of(file):
    data = file.read_bytes()
    return json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])


#: Materials beside whose textures there is more.
CONSTANTS = """<scene version="3.0.0">
  <bsdf type="principled" id="shiny"><float name="specular" value="1"/>
    <float name="clearcoat" value="0.8"/><float name="clearcoat_gloss" value="1"/></bsdf>
  <bsdf type="principled" id="velvet"><float name="eta" value="1.3"/>
    <float name="sheen" value="0.3"/></bsdf>
  <bsdf type="plastic" id="plastic"><rgb name="diffuse_reflectance" value="0.1 0.2 0.4"/>
    <float name="int_ior" value="1.6"/></bsdf>
  <bsdf type="diffuse" id="spectral">
    <spectrum name="reflectance" value="400:0.3, 700:0.6"/></bsdf>
  <shape type="rectangle" id="a"><ref id="shiny"/></shape>
  <shape type="rectangle" id="b"><ref id="velvet"/></shape>
  <shape type="rectangle" id="c"><ref id="plastic"/></shape>
  <shape type="rectangle" id="d"><ref id="spectral"/></shape>
  <emitter type="constant"/></scene>"""


def test_materials_keep_what_they_have_beside_textures(tmp_path):
    (tmp_path / "scene.xml").write_text(CONSTANTS)
    found = read_parts(tmp_path / "scene.xml", tmp_path)
    parts = {part.name: part for part in found.parts}
    shiny, velvet, spectral = (
        material_constants(found.scene, parts[name].materials) for name in "abd"
    )
    assert shiny.ior == pytest.approx(2 / (1 - 0.08**0.5) - 1) and velvet.ior == pytest.approx(1.3)
    assert spectral == Constants(pytest.approx(1.5), 0.0, pytest.approx(0.1**0.5), ())
    assert (shiny.clearcoat, velvet.clearcoat) == (pytest.approx(0.2), 0)
    assert shiny.clearcoat_roughness == pytest.approx(0.001**0.5)
    assert (shiny.left_out, velvet.left_out) == ((), ("sheen",))
    document = Document()
    plastic = gltf.plain_material(document, found.scene, parts["c"], None)
    factors = plastic["pbrMetallicRoughness"]
    assert factors["baseColorFactor"] == pytest.approx([0.1, 0.2, 0.4, 1])
    assert factors["roughnessFactor"] == 0
    assert plastic["extensions"] == {"KHR_materials_ior": {"ior": pytest.approx(1.6)}}


PANE = """<scene version="3.0.0">
  <shape type="rectangle" id="floor"><bsdf type="diffuse"/></shape>
  <shape type="rectangle" id="pane"><bsdf type="thindielectric"/></shape>
  <shape type="sphere" id="lens"><bsdf type="dielectric"/></shape>
  <shape type="cube" id="helper"><bsdf type="null"/></shape>
  <shape type="disk" id="lamp"><bsdf type="null"/><emitter type="area"/></shape></scene>"""


def test_panes_have_two_sides_and_mere_boundaries_are_left_out(tmp_path):
    from pxr import Usd, UsdGeom

    scene = tmp_path / "scene"
    scene.mkdir()
    (scene / "scene.xml").write_text(PANE)
    data = grey_data(scene / "scene.xml", tmp_path / "data")
    fit(data, tmp_path / "run", replace(tiny_fields("grid"), method="direct", steps=0))
    options = {"texels": 2.0, "tell": lambda line: None}
    manifest = exporting.export(tmp_path / "run", tmp_path / "out", ["gltf", "usd"], **options)
    note = "glTF and usd have no surfaces that nobody sees (null): without helper"
    assert note in manifest["notes"]
    made = document_of(tmp_path / "out" / "scene.glb")
    sides = {
        mesh["name"]: made["materials"][mesh["primitives"][0]["material"]]["doubleSided"]
        for mesh in made["meshes"]
    }
    assert sides == {"floor": False, "pane": True, "lens": False, "lamp": False}
    stage = Usd.Stage.Open(str(tmp_path / "out" / "usd" / "scene.usdc"))
    meshes = {p.GetDisplayName(): UsdGeom.Mesh(p) for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)}
    assert {name: mesh.GetDoubleSidedAttr().Get() for name, mesh in meshes.items()} == sides


def cameras_of(up):
    """Cameras that look at the origin from three places."""
    eyes = [(2.0, 1.9, 1.8), (-2.1, 1.7, 2.2), (1.8, -2.2, 1.9)]
    return [LookAt(eye, (0, 0, 0), up, 40.0).camera(8, 8) for eye in eyes]


def leaning(degrees):
    """An up that leans from +z towards +x and +y."""
    sin, cos = np.sin(np.radians(degrees)), np.cos(np.radians(degrees))
    return (0.8 * sin, 0.6 * sin, cos)


@pytest.mark.parametrize(
    ("up", "taken", "usd", "told"),
    [
        ((0, 0, 1), (0, 0, 1), "Z", None),
        ((0, 1, 0), (0, 1, 0), "Y", None),
        ((0, -1, 0), (0, -1, 0), "Y", "−y"),
        ((-1, 0, 0), (-1, 0, 0), "Y", "−x"),
        (leaning(5), (0, 0, 1), "Z", None),
        (leaning(25), leaning(25), "Z", "25° from +z"),
    ],
)
def test_files_stand_upright(up, taken, usd, told, tmp_path):
    from pxr import Usd, UsdGeom

    cameras = cameras_of(up)
    found = Up.of(cameras)
    np.testing.assert_allclose(found.direction, taken, atol=1e-6)
    notes = exporting._of_axes(cameras, ["gltf", "usd"])
    assert (not notes) if told is None else f"up is {told} by the cameras" in notes[0]
    assert not exporting._of_axes(cameras, ["mitsuba", "textures"])
    document = Document()
    names = [document.add("nodes", {"name": "part"}) for _ in range(2)]
    document.json["scenes"][0]["nodes"] += names
    document.turn(found)
    nodes, (*tops,) = document.json["nodes"], document.json["scenes"][0]["nodes"]
    if up == (0, 1, 0):
        assert tops == names and len(nodes) == 2
    else:
        (top,) = (nodes[number] for number in tops)
        x, y, z, w = top["rotation"]
        about, start = np.array([x, y, z]), np.array(taken)
        turned = start + 2 * np.cross(about, np.cross(about, start) + w * start)
        np.testing.assert_allclose(turned, (0, 1, 0), atol=1e-6)
        np.testing.assert_allclose(found.rotation("Y") @ start, (0, 1, 0), atol=1e-6)
        assert top["children"] == names and x * x + y * y + z * z + w * w == pytest.approx(1)
    write_usd(tmp_path, None, [], [], [], None, found)
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    assert UsdGeom.GetStageUpAxis(stage) == usd
    turn = UsdGeom.Xformable(stage.GetDefaultPrim()).ComputeLocalToWorldTransform(0)
    np.testing.assert_allclose(
        turn.TransformDir(tuple(map(float, taken))), np.eye(3)["XYZ".index(usd)], atol=1e-6
    )


def in_gltf(document, wanted):
    """What a node holds, by its key, with its matrix in the world, (4, 4), for all such nodes."""

    def walked(numbers, around):
        for node in (document["nodes"][number] for number in numbers):
            own = np.eye(4)
            if "matrix" in node:
                own = np.array(node["matrix"]).reshape(4, 4).T
            if "rotation" in node:
                x, y, z, w = node["rotation"]
                across = np.array([(0, -z, y), (z, 0, -x), (-y, x, 0)])
                own[:3, :3] = np.eye(3) + 2 * w * across + 2 * across @ across
            own = own @ np.diag([*node.get("scale", [1, 1, 1]), 1])
            if wanted(node):
                yield node, around @ own
            yield from walked(node.get("children", []), around @ own)

    return list(walked(document["scenes"][0]["nodes"], np.eye(4)))


@pytest.mark.parametrize("metres", [1.0, 0.001])
@pytest.mark.parametrize("up", [(0, 1, 0), leaning(25)])
def test_cameras_of_files_see_what_those_of_the_data_set_see(up, metres, tmp_path):
    from pxr import Gf, Usd, UsdGeom

    given = [
        replace(camera, fl_y=1.3 * camera.fl_x, height=11, cy=5.5) for camera in cameras_of(up)
    ]
    shot = Shot.of({f"a view/{i}": camera for i, camera in enumerate(given)}, [])
    assert 0 < shot.near < 0.1 and shot.far > 20 and shot.off_centre() == 0
    points = np.random.default_rng(0).normal(size=(50, 3)) * 0.4
    write_glb(tmp_path / "scene.glb", None, [], [], [], Up.of(given), metres, shot)
    document = document_of(tmp_path / "scene.glb")
    found = in_gltf(document, lambda node: "camera" in node)
    assert [node["name"] for node, _ in found] == [f"camera {name}" for name in shot.cameras]
    assert [entry["name"] for entry in document["cameras"]] == [*shot.cameras]
    upright = metres * points @ Up.of(given).rotation("Y").T
    for camera, (node, world) in zip(given, found, strict=True):
        np.testing.assert_allclose(world[:3, :3] @ world[:3, :3].T, np.eye(3), atol=1e-6)
        x, y, z = ((upright - world[:3, 3]) @ world[:3, :3]).T
        told = document["cameras"][node["camera"]]["perspective"]
        high = np.tan(told["yfov"] / 2)
        column = (1 - x / z / (high * told["aspectRatio"])) * camera.width / 2
        row = (1 + y / z / high) * camera.height / 2
        np.testing.assert_allclose(np.stack([column, row], 1), camera.project(points), atol=1e-3)
        assert told["znear"] == pytest.approx(shot.near * metres)
    off = {name: replace(camera, cx=5.0, cy=3.5) for name, camera in shot.cameras.items()}
    shot = Shot.of(off, [])
    assert shot.off_centre() == 2
    write_usd(tmp_path, None, [], [], [], None, Up.of(given), metres, shot)
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    assert UsdGeom.GetStageMetersPerUnit(stage) == metres
    cameras = [p for p in stage.Traverse() if p.IsA(UsdGeom.Camera)]
    assert [prim.GetDisplayName() for prim in cameras] == [*off]
    turn = UsdGeom.Xformable(stage.GetDefaultPrim()).ComputeLocalToWorldTransform(0)
    for camera, prim in zip(off.values(), cameras, strict=True):
        seen = UsdGeom.Camera(prim).GetCamera(0)
        assert seen.horizontalAperture * Gf.Camera.APERTURE_UNIT * metres == pytest.approx(0.036)
        matrix = seen.frustum.ComputeViewMatrix() * seen.frustum.ComputeProjectionMatrix()
        x, y = np.array([matrix.Transform(turn.Transform(Gf.Vec3d(*p))) for p in points])[:, :2].T
        pixels = np.stack([(1 + x) * camera.width / 2, (1 - y) * camera.height / 2], 1)
        np.testing.assert_allclose(pixels, camera.project(points), atol=1e-3)


def test_no_two_nodes_have_one_name(tmp_path):
    """A part, the node of all cameras and a view may be called alike; trimesh mixes them up."""
    (given, *_) = cameras_of((0, 0, 1))
    shot = Shot.of({"cameras": given, "thing": given}, [])
    document = Document()
    for name in ("thing", "camera thing", "cameras"):
        document.json["scenes"][0]["nodes"].append(document.add("nodes", {"name": name}))
    gltf._add_cameras(document, shot, 1.0)
    names = [node["name"] for node in document.json["nodes"]]
    assert len(names) == 6 and len(set(names)) == 6


def test_of_very_many_views_some_are_cameras(monkeypatch):
    monkeypatch.setattr("unbake.exports.cameras.MOST", 2)
    (camera, *_) = cameras_of((0, 1, 0))
    shot = Shot.of({f"{i}": replace(camera, cx=4.0 + 0.3 * i) for i in range(5)}, [])
    assert [*shot.cameras] == ["0", "4"]
    notes = exporting._of_cameras(shot, 5, ["gltf", "usd"])
    assert notes[0] == "2 of 5 views are cameras in glTF and usd"
    assert notes[1].endswith("pictures are shifted by up to 1.2 pixels")
    assert exporting._of_cameras(shot, 2, ["usd"]) == []


def test_lights_are_as_bright_where_units_are_not_metres(tmp_path):
    kinds = ("point", "spot", "directional")
    lights = [
        Light(kind, i, kind, (1.0, 2.0, 4.0), False, None, True, np.eye(4), (0.2, 0.4))
        for i, kind in enumerate(kinds)
    ]
    up = Up.of(cameras_of((0, 1, 0)))
    write_glb(tmp_path / "scene.glb", None, [], [], lights, up, 0.01)
    document = document_of(tmp_path / "scene.glb")
    made = document["extensions"]["KHR_lights_punctual"]["lights"]
    assert [light["intensity"] for light in made] == pytest.approx([4e-4, 4e-4, 4])
    assert [light["color"] for light in made] == [[0.25, 0.5, 1]] * 3
    for _, world in in_gltf(document, lambda node: "extensions" in node):
        np.testing.assert_allclose(world @ world.T, np.eye(4), atol=1e-9)
    (note,) = exporting._of_strengths(lights, 0.01, ["usd"])
    assert "by 0.0001" in note and note.endswith(": point, spot")
    assert not exporting._of_strengths(lights, 1.0, ["usd"])
    assert not exporting._of_strengths(lights[2:], 0.01, ["usd"])


#: Lamps that are solids, and lamps with backs that are dark in Mitsuba.
LAMPS = """<scene version="3.0.0">
  <shape type="rectangle" id="panel"><emitter type="area"/></shape>
  <shape type="disk" id="spot"><emitter type="area"/></shape>
  <shape type="disk" id="off"><emitter type="area"/></shape>
  <shape type="sphere" id="bulb"><emitter type="area"/></shape>
  <shape type="cube" id="box"><emitter type="area"/></shape>
  <shape type="rectangle" id="wall"/></scene>"""


def test_lamps_with_backs_are_told(tmp_path):
    (tmp_path / "scene.xml").write_text(LAMPS)
    parts = read_parts(tmp_path / "scene.xml", tmp_path).parts
    lights = [
        SimpleNamespace(node=part.emitter, strength=(float(part.name != "off"),) * 3)
        for part in parts
        if part.emitter is not None
    ]
    (note,) = exporting._of_backs(parts, lights, ["gltf"])
    assert note.endswith(": panel, spot") and "Backfacing" in note
    assert exporting._of_backs(parts, lights, ["usd"]) == [note]
    assert not exporting._of_backs(parts, lights, ["mitsuba"])


@pytest.mark.parametrize(
    ("across", "metres", "told"),
    [
        (
            6000,
            1.0,
            "the scene is 6000 m across: if units are millimetres, --metres-per-unit 0.001",
        ),
        (400, 1.0, "the scene is 400 m across: if units are centimetres, --metres-per-unit 0.01"),
        (1e7, 1.0, "the scene is 10000000 m across: --metres-per-unit tells how long a unit is"),
        (0.002, 1.0, "the scene is 0.002 m across: --metres-per-unit tells how long a unit is"),
        (6, 0.001, "the scene is 0.006 m across: --metres-per-unit tells how long a unit is"),
        (6000, 0.001, None),
        (0.5, 1.0, None),
        (150, 1.0, None),
    ],
)
def test_scenes_whose_unit_may_be_another_are_told(across, metres, told):
    part = SimpleNamespace(is_shown=True, triangles=triangle((0, 0, 0), (across, 0, 0), (0, 0, 0)))
    for formats in (["gltf"], ["usd", "textures"]):
        assert exporting._of_size([part], metres, formats) == ([] if told is None else [told])
    assert not exporting._of_size([part], metres, ["mitsuba", "textures"])


def test_units_and_cameras_are_as_wanted(exported, tmp_path, unbake, monkeypatch):
    manifest = exported.manifest
    assert manifest["metres_per_unit"] == 1 and manifest["cameras"] == ["view_0", "view_1"]
    exported.use(monkeypatch)
    words = ("--format", "gltf", "usd", "--texels", 2, "--metres-per-unit", 0.01, "--no-cameras")
    outcome = unbake("export", exported.run, "--out", tmp_path / "out", *words)
    assert outcome.status == 0, outcome.err
    told = json.loads((tmp_path / "out" / "export.json").read_text())
    assert told["metres_per_unit"] == 0.01 and told["cameras"] == []
    document = document_of(tmp_path / "out" / "scene.glb")
    (top,) = (document["nodes"][number] for number in document["scenes"][0]["nodes"])
    assert top["scale"] == [0.01] * 3 and "cameras" not in document
    assert all(set(node) >= {"mesh"} for node in document["nodes"] if node["name"] == "ground")
    outcome = unbake("export", exported.run, "--out", tmp_path / "no", "--metres-per-unit", "nan")
    assert outcome.status == 2 and "--metres-per-unit: must be between" in outcome.err
    options = {"metres_per_unit": 0.01, "cameras": False}
    with pytest.raises(UserError) as refused:
        exporting.export(exported.run, tmp_path / "no", "mitsuba,textures", **options)
    for option in ("--metres-per-unit", "--no-cameras"):
        assert f"{option}: is for gltf and usd" in str(refused.value)


def test_the_environment_of_gltf_stands_upright(tmp_path):
    """What shines from a direction of the scene shines from where the node `upright` turns it."""
    picture = np.zeros((32, 64, 3), np.float32)
    picture[12:14, 20:22] = 50
    up = Up.of(cameras_of(leaning(40)))
    for formats, told in (
        (["gltf"], ""),
        (["gltf", "usd"], ", as in usd"),
        (["gltf", "mitsuba", "usd"], ", as in mitsuba and usd"),
    ):
        notes = exporting._environment_of_gltf(tmp_path, picture, up, formats)
        assert notes == [
            "glTF has no environment: for scene.glb it is environment_upright.exr",
            "in Blender, its Environment Texture needs a Mapping, Rotation Z 90°",
            f"environment.exr has the axes of the scene{told}",
        ]
    write_exr(tmp_path / "environment.exr", picture)
    d = np.random.default_rng(0).normal(size=(3, 4000))
    d = (d / np.linalg.norm(d, axis=0)).astype(np.float32)
    means = []
    for name, ahead in (("environment", d), ("environment_upright", up.rotation("Y") @ d)):
        light = mi.load_dict({"type": "envmap", "filename": str(tmp_path / f"{name}.exr")})
        si = dr.zeros(mi.SurfaceInteraction3f, 4000)
        si.wi = mi.Vector3f(-ahead.astype(np.float32))
        seen = np.array(light.eval(si))[0]
        means.append((ahead * seen).sum(1) / seen.sum())
    assert np.linalg.norm(means[0]) > 0.9
    np.testing.assert_allclose(up.rotation("Y") @ means[0], means[1], atol=0.03)
    level = Up.of(cameras_of((0, 1, 0)))
    note, turn = exporting._environment_of_gltf(tmp_path / "none", picture, level, ["gltf"])
    assert note.endswith("for scene.glb it is environment.exr") and "Rotation Z 90°" in turn
    assert not (tmp_path / "none").exists()


def test_files_have_constants_and_what_is_left_out_is_told(tmp_path):
    from pxr import Usd, UsdShade

    scene = tmp_path / "scene"
    scene.mkdir()
    (scene / "scene.xml").write_text(CONSTANTS)
    data = grey_data(scene / "scene.xml", tmp_path / "data")
    config = replace(tiny_fields("grid"), method="direct", steps=0)
    fit(data, tmp_path / "run", replace(config, quantities=("roughness",)))
    options = {"texels": 2.0, "tell": lambda line: None}
    manifest = exporting.export(tmp_path / "run", tmp_path / "out", ["gltf", "usd"], **options)
    told = "unbake does not write sheen to glTF and usd: left out of velvet"
    assert told in manifest["notes"]
    made = document_of(tmp_path / "out" / "scene.glb")["materials"]
    shiny = next(m for m in made if m["name"] == "shiny")["extensions"]
    assert shiny["KHR_materials_ior"]["ior"] == pytest.approx(1.789, abs=1e-3)
    assert shiny["KHR_materials_clearcoat"]["clearcoatFactor"] == pytest.approx(0.2)
    stage = Usd.Stage.Open(str(tmp_path / "out" / "usd" / "scene.usdc"))
    materials = {p.GetDisplayName(): p for p in stage.Traverse() if p.IsA(UsdShade.Material)}
    surface = UsdShade.Material(materials["shiny"]).ComputeSurfaceSource()[0]
    assert surface.GetInput("ior").Get() == pytest.approx(1.789, abs=1e-3)
    assert surface.GetInput("clearcoat").Get() == pytest.approx(0.2)
    assert {row["name"] for row in manifest["materials"]} == {"shiny", "velvet", "spectral"}


def test_whole_numbers_are_numbers(tmp_path):
    given = """<integer name="eta" value="2"/><integer name="clearcoat" value="1"/>
      <integer name="clearcoat_gloss" value="1"/>"""
    text = f'<scene version="3.0.0"><bsdf type="principled">{given}</bsdf></scene>'
    (tmp_path / "scene.xml").write_text(text)
    found = material_constants(parsed_principled(tmp_path / "scene.xml", tmp_path), [0])
    assert (found.ior, found.clearcoat, found.left_out) == (2.0, 0.25, ())
    assert found.clearcoat_roughness == pytest.approx(0.001**0.5)
    material = plain("roughconductor", '<integer name="alpha" value="1"/>', tmp_path)
    assert material["pbrMetallicRoughness"]["roughnessFactor"] == 1


def test_ids_that_nobody_chose_are_no_names(tmp_path):
    """Those that Mitsuba gives where it writes a scene."""
    sheet = triangle((0, 0, 0), (1, 0, 0), (0, 1, 0))
    write_mesh(tmp_path / "door.ply", *sheet.arrays)
    (tmp_path / "scene.xml").write_text(
        """<scene version="3.0.0"><bsdf type="principled" id="elm__1"/>
          <shape type="ply" id="elm__2"><string name="filename" value="door.ply"/>
            <ref id="elm__1"/></shape>
          <shape type="rectangle" id="floor"><bsdf type="diffuse"/></shape></scene>"""
    )
    found = read_parts(tmp_path / "scene.xml", tmp_path)
    assert [part.name for part in found.parts] == ["door", "floor"]
    assert [atlas.name for atlas in make_atlases(found.scene, found.parts, 2.0)] == [
        "door",
        "floor",
    ]


def test_textures_whose_coordinates_no_file_has_are_told(exported, tmp_path, monkeypatch):
    exported.use(monkeypatch)
    options = {"texels": 2.0, "tell": lambda line: None}
    for formats, told in ((["textures"], True), (["textures", "gltf"], False)):
        out = tmp_path / "-".join(formats)
        notes = exporting.export(exported.run, out, formats, **options)["notes"]
        assert [n.endswith("for meshes that have them") for n in notes if "unwrapped" in n] == (
            [True] * told
        )
        assert not told or any("has: stone, cloth; add gltf" in note for note in notes)


def test_what_blender_makes_of_lights_is_told(exported):
    (note,) = (note for note in exported.manifest["notes"] if "Unitless" in note)
    assert note.endswith("for torch") and "Blender" in note


@pytest.mark.parametrize(
    ("given", "ior"),
    [
        ('<float name="specular" value="-1"/><float name="clearcoat_gloss" value="-3"/>', 1.0),
        ('<float name="specular" value="12.5"/><float name="clearcoat_gloss" value="4"/>', 98.0),
        ('<float name="specular" value="20"/><float name="clearcoat" value="9"/>', 98.0),
    ],
)
def test_constants_beyond_what_any_material_has_are_limited(given, ior, tmp_path):
    text = f'<scene version="3.0.0"><bsdf type="principled">{given}</bsdf></scene>'
    (tmp_path / "scene.xml").write_text(text)
    found = material_constants(parsed_principled(tmp_path / "scene.xml", tmp_path), [0])
    assert found.ior == pytest.approx(ior, rel=0.02)
    assert 0 <= found.clearcoat <= 1 and 0 < found.clearcoat_roughness <= 0.1**0.5 + 1e-9


def plain(plugin, given, folder, shape="rectangle"):
    """The glTF material of a known BSDF with these parameters."""
    (folder / "scene.xml").write_text(
        f'''<scene version="3.0.0"><shape type="{shape}"><bsdf type="{plugin}">{given}</bsdf>
          </shape><emitter type="constant"/></scene>'''
    )
    found = read_parts(folder / "scene.xml", folder)
    return gltf.plain_material(Document(), found.scene, found.parts[0], None)


TEXTURE = '<texture type="checkerboard" name="alpha"/>'
WIDTHS = '<float name="alpha_u" value="{}"/><float name="alpha_v" value="{}"/>'


@pytest.mark.parametrize(
    ("plugin", "given", "alpha"),
    [
        ("roughconductor", '<float name="alpha" value="0.3"/>', 0.3),
        ("roughconductor", "", 0.1),
        ("roughconductor", TEXTURE, 0.1),
        ("roughdielectric", TEXTURE, 0.1),
        ("roughconductor", WIDTHS.format(0.1, 0.5), 0.3),
        ("roughdielectric", WIDTHS.format(0.2, 0.4), 0.3),
        ("conductor", "", 0.0),
    ],
)
def test_plain_materials_are_as_rough_as_mitsuba_s(plugin, given, alpha, tmp_path):
    material = plain(plugin, given, tmp_path)
    assert material["pbrMetallicRoughness"]["roughnessFactor"] == pytest.approx(alpha**0.5)


ETA, K = np.array((4.37, 2.92, 1.65)), np.array((5.21, 4.23, 3.75))
OF_ALUMINIUM = (
    f'<rgb name="eta" value="{", ".join(map(str, ETA))}"/>'
    f'<rgb name="k" value="{", ".join(map(str, K))}"/>'
)


@pytest.mark.parametrize(
    ("plugin", "given", "colour"),
    [
        ("roughconductor", OF_ALUMINIUM, ((ETA - 1) ** 2 + K**2) / ((ETA + 1) ** 2 + K**2)),
        ("conductor", '<string name="material" value="none"/>', (1, 1, 1)),
        ("conductor", '<rgb name="specular_reflectance" value="0.5, 0.4, 0.2"/>', (0.5, 0.4, 0.2)),
        (
            "dielectric",
            '<rgb name="specular_transmittance" value="0.2, 0.9, 0.3"/>',
            (0.2, 0.9, 0.3),
        ),
        ("dielectric", "", (1, 1, 1)),
        ("conductor", TEXTURE.replace("alpha", "specular_reflectance"), (0.9, 0.9, 0.9)),
    ],
)
def test_known_metal_and_glass_have_mitsuba_s_colours(plugin, given, colour, tmp_path):
    material = plain(plugin, given, tmp_path)
    made = material["pbrMetallicRoughness"]["baseColorFactor"]
    assert made == pytest.approx([*colour, 1], abs=1e-3)


def test_known_glass_has_the_index_of_its_name(tmp_path):
    material = plain("dielectric", '<string name="int_ior" value="diamond"/>', tmp_path)
    assert material["extensions"]["KHR_materials_ior"]["ior"] == pytest.approx(2.419, abs=1e-3)


@pytest.mark.parametrize(
    ("plugin", "shape", "thickness"),
    [
        ("dielectric", "cube", 2.0),
        ("roughdielectric", "cube", 2.0),
        ("dielectric", "rectangle", 0.02),
        ("thindielectric", "cube", None),
        ("conductor", "cube", None),
    ],
)
def test_solid_glass_has_a_thickness_and_panes_have_none(plugin, shape, thickness, tmp_path):
    made = plain(plugin, "", tmp_path, shape).get("extensions", {})
    assert ("KHR_materials_transmission" in made) == (plugin != "conductor")
    told = None if thickness is None else {"thicknessFactor": pytest.approx(thickness)}
    assert made.get("KHR_materials_volume") == told


@pytest.mark.parametrize("kind", ["usd", "mitsuba"])
def test_masks_of_what_no_view_saw_come_with_all_formats(kind, exported, tmp_path, monkeypatch):
    exported.use(monkeypatch)
    options = {"texels": 2.0, "tell": lambda line: None}
    manifest = exporting.export(exported.run, tmp_path / "out", [kind], **options)
    assert manifest["materials"]
    for row in manifest["materials"]:
        assert (tmp_path / "out" / row["unobserved"]).is_file()


def test_gltf_has_the_lights(exported):
    document = document_of(exported.folder / "scene.glb")
    used = {"KHR_lights_punctual", "KHR_materials_emissive_strength", "KHR_materials_transmission"}
    used |= {"KHR_materials_volume"}
    assert used <= set(document["extensionsUsed"])
    (light,) = document["extensions"]["KHR_lights_punctual"]["lights"]
    assert light["type"] == "spot" and light["intensity"] == 4 and light["color"] == [0.25, 0.5, 1]
    (node,) = (n for n in document["nodes"] if "extensions" in n)
    assert [camera["name"] for camera in document["cameras"]] == ["view_0", "view_1"]
    matrix = np.array(node["matrix"]).reshape(4, 4).T
    np.testing.assert_allclose(matrix[:3, 3], [1, -1, 1.5], atol=1e-5)
    ahead = np.array([-1, 1, -1.5]) / np.linalg.norm([-1, 1, -1.5])
    np.testing.assert_allclose(-matrix[:3, 2], ahead, atol=1e-5)
    (lamp,) = (m for m in document["materials"] if "emissiveFactor" in m)
    assert lamp["emissiveFactor"] == pytest.approx([1, 4 / 6, 2 / 6])
    assert lamp["extensions"]["KHR_materials_emissive_strength"]["emissiveStrength"] == 6


def test_usd_has_the_parts_and_the_recovered_materials(exported):
    from pxr import Usd, UsdGeom, UsdShade

    stage = Usd.Stage.Open(str(exported.folder / "usd" / "scene.usdc"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and stage.GetDefaultPrim().GetName() == "scene"
    told = {part["name"]: part["material"] for part in exported.manifest["parts"]}
    meshes = {p.GetDisplayName(): p for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)}
    assert meshes.keys() == told.keys()
    rng = np.random.default_rng(1)
    for name, prim in meshes.items():
        mesh = UsdGeom.Mesh(prim)
        material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
        surface = material.ComputeSurfaceSource()[0]
        assert surface.GetIdAttr().Get() == "UsdPreviewSurface"
        if told[name] is None:
            assert not surface.GetInput("diffuseColor").HasConnectedSource()
            continue
        assert material.GetPrim().GetDisplayName() == told[name]
        points = np.array(mesh.GetPointsAttr().Get())
        corners = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        st = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get())
        areas = np.linalg.norm(np.cross(*(points[corners[:, i]] - points[corners[:, 0]]
                                          for i in (1, 2))), axis=1)  # fmt: skip
        chosen = corners[rng.choice(len(corners), 500, p=areas / areas.sum())]
        weights = rng.dirichlet([1, 1, 1], 500)
        at = np.einsum("nk,nkd->nd", weights, points[chosen])
        uv = np.einsum("nk,nkd->nd", weights, st[chosen]) * [1, -1] + [0, 1]
        truth = material_at(exported.recovered, at)
        truth["albedo"] = srgb(truth["albedo"])
        read = {"diffuseColor": ("albedo", "sRGB"), "roughness": ("roughness", "raw")}
        for target, (quantity, space) in read.items():
            (source,) = surface.GetInput(target).GetConnectedSources()[0]
            texture = UsdShade.Shader(source.source.GetPrim())
            assert texture.GetInput("sourceColorSpace").Get() == space
            file = texture.GetInput("file").Get().resolvedPath
            assert Path(file).parent == exported.folder / "usd" / "textures"
            found = looked_up(as_pixels(file), uv)
            error = np.abs(found - 255 * np.atleast_2d(truth[quantity].T).T)
            assert (error.max(1) <= 2).mean() > 0.98, (name, target)
        assert mesh.GetDoubleSidedAttr().Get() == (name == "ground")


def test_all_prims_of_usd_have_a_type(exported):
    """Blender does not turn what is below a prim without one."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(exported.folder / "usd" / "scene.usdc"))
    assert not [p.GetPath() for p in stage.Traverse() if not p.GetTypeName()]
    meshes = [p for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)]
    assert meshes and all(p.GetParent().IsA(UsdGeom.Imageable) for p in meshes)


def as_pixels(file):
    """A PNG file as (H, W, channels)."""
    pixels = np.array(mi.Bitmap(file))
    return pixels.reshape(*pixels.shape[:2], -1)


def test_usd_has_the_lights(exported):
    from pxr import Usd, UsdGeom, UsdLux, UsdShade

    stage = Usd.Stage.Open(str(exported.folder / "usd" / "scene.usdc"))
    (torch,) = (p for p in stage.Traverse() if p.IsA(UsdLux.SphereLight))
    light = UsdLux.SphereLight(torch)
    assert torch.GetDisplayName() == "torch" and light.GetNormalizeAttr().Get()
    # The radiance of a sphere, times what is seen of it, is the radiant intensity.
    assert light.GetIntensityAttr().Get() / 4 == 4
    np.testing.assert_allclose(light.GetColorAttr().Get(), [0.25, 0.5, 1])
    assert UsdLux.ShapingAPI(torch).GetShapingConeAngleAttr().Get() == pytest.approx(20)
    matrix = np.array(UsdGeom.Xformable(torch).ComputeLocalToWorldTransform(0)).T
    np.testing.assert_allclose(matrix[:3, 3], [1, -1, 1.5], atol=1e-5)
    ahead = np.array([-1, 1, -1.5]) / np.linalg.norm([-1, 1, -1.5])
    np.testing.assert_allclose(-matrix[:3, 2], ahead, atol=1e-5)
    (dome,) = (p for p in stage.Traverse() if p.IsA(UsdLux.DomeLight))
    found = UsdLux.DomeLight(dome).GetTextureFileAttr().Get().resolvedPath
    assert Path(found) == exported.folder / "usd" / "textures" / "environment.exr"
    np.testing.assert_array_equal(read_exr(found), read_exr(exported.folder / "environment.exr"))
    (lamp,) = (p for p in stage.Traverse() if p.GetDisplayName() == "lamp" and p.IsA(UsdGeom.Mesh))
    surface = UsdShade.MaterialBindingAPI(lamp).ComputeBoundMaterial()[0].ComputeSurfaceSource()[0]
    np.testing.assert_allclose(surface.GetInput("emissiveColor").Get(), [6, 4, 2], rtol=1e-5)


def test_usd_without_its_package_is_refused_at_once(exported, tmp_path, monkeypatch):
    monkeypatch.setattr("importlib.util.find_spec", lambda name, *_: None)
    with pytest.raises(UserError, match=r"--format.*usd-core.*pip install 'unbake\[usd\]'"):
        exporting.export(exported.run, tmp_path / "out", ["usd"])
    assert not (tmp_path / "out").exists()


RENDER = """
import sys
import mitsuba as mi, numpy as np
mi.set_variant(sys.argv[1])
scene = mi.load_file(sys.argv[2], parallel=False, optimize=False)
integrator = mi.load_dict({"type": "path", "max_depth": 4})
np.save(sys.argv[3], np.array(mi.render(scene, integrator=integrator, spp=2048, seed=0)))
print([shape.id() for shape in scene.shapes()])
assert not [name for name in sys.modules if name.startswith("unbake")]
"""


@pytest.mark.parametrize("colours", ["rgb", "spectral"])
def test_mitsuba_alone_renders_what_was_recovered(colours, exported, tmp_path):
    variant = mi.variant().replace("rgb", colours)
    scene, picture = exported.folder / "mitsuba" / "scene.xml", tmp_path / "picture.npy"
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, "-c", RENDER, variant, str(scene), str(picture)],
        env=environment, cwd=tmp_path, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert all(f"'{name}'" in done.stdout for name in ("ground", "block-2", "lens", "lamp"))
    problem = exported.recovered.problem
    integrator = mi.load_dict({"type": "path", "max_depth": 4})
    reference = mi.render(problem.scene_view.scene, integrator=integrator, spp=2048, seed=0)
    reference, found = (np.array(x)[..., :3] for x in (reference, np.load(picture)))
    scale = np.percentile(reference, 99)
    assert psnr(np.minimum(found / scale, 1), np.minimum(reference / scale, 1)) > 40


def test_the_environment_is_where_mitsuba_looks_for_it(exported):
    (file,) = exported.folder.glob("environment.*")
    emitter = mi.load_dict({"type": "envmap", "filename": str(file)})
    rng = np.random.default_rng(4)
    d = rng.normal(size=(3, 200))
    d = mi.Vector3f((d / np.linalg.norm(d, axis=0)).astype(np.float32))
    si = dr.zeros(mi.SurfaceInteraction3f, 200)
    si.wi = -d
    found, truth = np.array(emitter.eval(si)), exported.recovered.problem.environment.radiance(d)
    np.testing.assert_allclose(found, np.array(truth), rtol=0.05)
    # As `export.json` says: +y is the first row, +x at a quarter of the width.
    picture = read_exr(file)
    n = len(picture)
    for d, texel in (((0, 1, 0), (0, 0)), ((1, 0, 0), (n // 2, n // 2)), ((0, 0, 1), (n // 2, n))):
        truth = np.ravel(exported.recovered.problem.environment.radiance(mi.Vector3f(*d)))
        np.testing.assert_allclose(picture[texel], truth, rtol=0.1)


def test_an_environment_that_was_known_is_taken_along(with_metallic, tmp_path, monkeypatch):
    from pxr import Usd, UsdLux

    with_metallic.use(monkeypatch)
    out, words = tmp_path / "out", {"texels": 2.0, "tell": lambda line: None}
    formats = ["gltf", "mitsuba", "usd"]
    manifest = exporting.export(with_metallic.run, out, formats, **words)
    (file,) = out.glob("environment.*")
    for made in (file, out / "environment_upright.exr"):  # z is up
        np.testing.assert_allclose(read_exr(made), 0.5, rtol=1e-3)
    assert manifest["environment"] == file.name
    assert manifest["environment_upright"] == "environment_upright.exr"
    stage = Usd.Stage.Open(str(out / "usd" / "scene.usdc"))
    (dome,) = (p for p in stage.Traverse() if p.IsA(UsdLux.DomeLight))
    found = UsdLux.DomeLight(dome).GetTextureFileAttr().Get().resolvedPath
    assert Path(found) == out / "usd" / "textures" / file.name
    assert Path(found).read_bytes() == file.read_bytes()
    text = (out / "mitsuba" / "scene.xml").read_text()
    assert 'type="constant"' in text and 'type="envmap"' not in text
    assert any(note.startswith("glTF has no environment") for note in manifest["notes"])


def test_what_no_view_saw_is_filled_and_marked(exported, tmp_path, monkeypatch):
    exported.use(monkeypatch)
    lines = []
    out = tmp_path / "out"
    manifest = exporting.export(exported.run, out, ["textures"], texels=20.0, tell=lines.append)
    stone = next(row for row in manifest["materials"] if row["name"] == "stone")
    assert 0.3 < stone["unobserved_share"] < 0.95  # balls have backs, and both views are in front
    assert any("unobserved" in line for line in lines)
    unseen = np.array(mi.Bitmap(str(out / "textures" / "stone_unobserved.png")))
    albedo = read_exr(out / "textures" / "stone_albedo.exr")
    assert 0 < (unseen == 255).mean() < 1 and np.isfinite(albedo).all()
    # Filled values are means of seen ones, and so never beyond them.
    seen = albedo[unseen == 0]
    assert (albedo[unseen == 255] >= seen.min(0) - 1e-5).all()
    assert (albedo[unseen == 255] <= seen.max(0) + 1e-5).all()


@pytest.mark.parametrize(("learned", "told"), [(["albedo"], ", and is filled in"), ([], "")])
def test_only_what_was_learned_is_told_to_be_filled_in(learned, told):
    manifest = {"materials": [], "near": {}, "unobserved_share": 0.25, "notes": []}
    lines = []
    exporting._report(manifest | {"learned": learned}, lines.append)
    assert lines == [f"25.0 % of the surface was seen by no training view{told}"]


def test_recovered_strengths_are_numbers_of_the_scene(data, tmp_path, monkeypatch):
    config = replace(tiny_fields("grid"), method="direct", unknown="emission", steps=0)
    fit(data, tmp_path / "run", config)
    options = {"texels": 4.0, "tell": lambda line: None}
    manifest = exporting.export(tmp_path / "run", tmp_path / "out", ["mitsuba", "gltf"], **options)
    assert [light["recovered"] for light in manifest["lights"]] == [True] * 3
    text = (tmp_path / "out" / "mitsuba" / "scene.xml").read_text()
    for light in manifest["lights"]:
        (start,) = set(light["strength"])
        assert f"{start:.6g}"[:6] in text
    assert any("learned no materials" in note for note in manifest["notes"])


def test_strengths_stay_with_their_lights_where_the_environment_is_recovered_too(mixed):
    scene = with_more(mixed, '<emitter type="point" id="last"/>')
    config = replace(tiny_fields("grid"), unknown="lighting+emission")
    problem = make_problem(scene, "visible", config, 0.2)
    strengths = 1 + np.arange(len(problem.emitter_names))
    problem.emission.start(strengths / problem.emission.scale)
    found = read_lights(parse(scene, scene.parent), problem)
    assert len(found) > 1 and problem.environment is not None
    assert [light.name for light in found] == problem.emitter_names
    np.testing.assert_allclose([light.strength[0] for light in found], strengths, rtol=1e-5)


#: A lamp whose enamel no other shape has.
ENAMEL = """<scene version="3.0.0">
  <bsdf type="principled" id="enamel"><rgb name="base_color" value="0.9 0.1 0.3"/></bsdf>
  <bsdf type="diffuse" id="paint"/>
  <shape type="rectangle" id="floor"><ref id="paint"/></shape>
  <shape type="sphere" id="bulb"><ref id="enamel"/><float name="radius" value="0.3"/>
    <point name="center" x="0" y="0" z="1"/><emitter type="area"/></shape></scene>"""


@pytest.mark.parametrize("unknown", ["materials", "emission"])
def test_materials_that_were_not_learned_stay_as_they_are(unknown, tmp_path):
    learned, scene = unknown == "materials", tmp_path / "scene"
    scene.mkdir()
    (scene / "scene.xml").write_text(ENAMEL)
    data = grey_data(scene / "scene.xml", tmp_path / "data")
    config = replace(tiny_fields("grid"), method="direct", unknown=unknown, steps=0)
    fit(data, tmp_path / "run", config)
    options = {"texels": 4.0, "tell": lambda line: None}
    exporting.export(tmp_path / "run", tmp_path / "out", ["mitsuba"], **options)
    folder = tmp_path / "out" / "mitsuba"
    shapes = ElementTree.parse(folder / "scene.xml").getroot().findall("shape")
    found = {shape.get("id"): shape.get("type") for shape in shapes}
    assert found == {"floor": "ply" if learned else "rectangle", "bulb": "sphere"}
    assert any(folder.rglob("*.exr")) == any(folder.rglob("*.ply")) == learned
    ray = mi.Ray3f(mi.Point3f(0, 0, 3), mi.Vector3f(0, 0, -1))
    written = mi.load_file(str(folder / "scene.xml"))
    si = written.ray_intersect(ray)
    np.testing.assert_allclose(
        np.ravel(si.bsdf().eval_diffuse_reflectance(si)), [0.9, 0.1, 0.3], atol=1e-5
    )


# ------------------------------------------------------------------------------- the parts of a job


class SeenFrom:
    """Views that see what lies beyond a plane across the x axis."""

    def __init__(self, x):
        self._x = x

    def see(self, p, n, two_sided, active):
        return active & (p.x > self._x)


def rewritten(file, out, texels=100.0, *, refine=False):
    """Have Mitsuba's scene written with its own values, all in the coordinates of atlases."""
    found = read_parts(file, file.parent)
    scene, scratch, own = (parsed_principled(file, file.parent) for _ in range(3))
    wanted = [part for part in found.parts if part.is_optimized]
    baker = Baker(None, own_textures(own, ()), SeenFrom(-np.inf))
    baked = [baker.bake(atlas) for atlas in make_atlases(found.scene, wanted, texels)]
    assert {one.atlas.method for one in baked} == {"uvunwrap"}
    out.mkdir()
    camera = LookAt((0, 0, 3), (0, 0, 0), (0, 1, 0), 40).camera(16, 16)
    parts = found.parts
    return write_scene(out, scene, scratch, parts, baked, [], None, camera, refine=refine)


def two_sheets(name, x=0.0):
    """Squares of a material, one below the other, whose own coordinates are the same."""
    return "".join(
        f'''<shape type="rectangle"><ref id="{name}"/><transform name="to_world">
          <translate x="{x}" z="{z}"/></transform></shape>'''
        for z in (0, -0.5)
    )


#: A metal in two blends, and on a square alone.
BLENDS = f"""<scene version="3.0.0">
  <bsdf type="roughconductor" id="metal"><texture type="bitmap" name="alpha">
    <string name="filename" value="worn.exr"/><boolean name="raw" value="true"/>
    <string name="filter_type" value="nearest"/></texture></bsdf>
  <bsdf type="blendbsdf" id="grey"><float name="weight" value="0.5"/>
    <bsdf type="diffuse"/><ref id="metal"/></bsdf>
  <bsdf type="blendbsdf" id="green"><float name="weight" value="0.7"/>
    <bsdf type="diffuse"><rgb name="reflectance" value="0.1 0.6 0.2"/></bsdf>
    <ref id="metal"/></bsdf>
  {two_sheets("grey")}{two_sheets("green", 3)}
  <shape type="rectangle"><ref id="metal"/><transform name="to_world"><translate x="6"/>
    </transform></shape>
  <emitter type="constant"/></scene>"""


def test_a_metal_in_several_materials_keeps_its_texture_in_all(tmp_path):
    rng = np.random.default_rng(0)
    write_exr(tmp_path / "worn.exr", rng.uniform(0.2, 0.9, (4, 4)))
    (tmp_path / "scene.xml").write_text(BLENDS)
    made = rewritten(tmp_path / "scene.xml", tmp_path / "out")
    original = parsed_principled(tmp_path / "scene.xml", tmp_path).instantiate(merge=False)
    written = mi.load_file(str(made.path), optimize=False)
    for x in (0, 3, 6):
        places = rng.uniform(-0.99, 0.99, (2, 1000)).astype(np.float32)
        ray = mi.Ray3f(mi.Point3f(places[0] + x, places[1], 1), mi.Vector3f(0, 0, -1))
        truth, found = (
            np.array(si.bsdf().eval(mi.BSDFContext(), si, mi.Vector3f(0.6, 0, 0.8)))
            for si in (original.ray_intersect(ray), written.ray_intersect(ray))
        )
        assert np.ptp(truth) > 0.1, x
        assert (np.abs(found - truth).max(0) < 0.01).mean() > 0.9, x


def striped(name, slot, folder, *, count=16, low=0.0, high=1.0):
    """A texture of stripes with sharp edges."""
    stripes = np.broadcast_to(np.arange(4 * count) // 4 % 2, (64, 4 * count))
    write_exr(folder / f"{name}.exr", (low + (high - low) * stripes).astype(np.float32))
    return f'''<texture type="bitmap" name="{slot}"><string name="filename" value="{name}.exr"/>
      <boolean name="raw" value="true"/><string name="filter_type" value="nearest"/></texture>'''


@pytest.mark.parametrize(
    ("slot", "stripes", "size"),
    [
        ("metallic", {}, 512),
        ("opacity", {"low": 0.3, "high": 0.7}, 512),
        ("opacity", {"count": 60}, 256),  # a cut-out, which shows where it is above a half
    ],
)
def test_known_textures_are_as_fine_as_in_the_scene(slot, stripes, size, tmp_path):
    """Smooth fields ask for less; a texture that stays coarse is told."""
    texture = striped("stripes", slot, tmp_path, **stripes)
    inner = f'<bsdf type="principled" id="sheet">{texture if slot == "metallic" else ""}</bsdf>'
    bsdf = f'<bsdf type="mask">{texture}{inner}</bsdf>' if slot == "opacity" else inner
    (tmp_path / "scene.xml").write_text(
        f'<scene version="3.0.0"><shape type="rectangle">{bsdf}</shape></scene>'
    )
    asked = {"refine": True, "known": True}
    baked = {
        words: baked_of(
            tmp_path / "scene.xml", SeenFrom(-np.inf), 2.0, **{k: asked[k] for k in words}
        )["sheet"]
        for words in [("refine", "known"), ("known",), ("refine",), ()]
    }
    sizes = {words: one.atlas.resolution for words, one in baked.items()}
    assert sizes == {("refine", "known"): size, ("known",): 64, ("refine",): 64, (): 64}
    coarse = {words: one.coarse for words, one in baked.items()}
    assert coarse == {("refine", "known"): [], ("known",): [slot], ("refine",): [], (): []}
    (note,) = (n for n in exporting._notes(PARTS, [baked["known",]], [], "more") if slot in n)
    assert note == f"{slot} is coarser than in the scene in sheet; more"


PARTS = SimpleNamespace(left_out=[])


def test_soft_edges_of_cut_outs_ask_for_no_more_texels(tmp_path):
    """What other programs show of them is right long before their opacities are."""
    y, x = (np.mgrid[:64, :64] + 0.5) / 64
    leaf = np.zeros((64, 64), np.float32)
    for column, row in np.random.default_rng(0).random((12, 2)):
        leaf[np.hypot((x - column) / 0.06, (y - row) / 0.12) < 1] = 1
    write_exr(tmp_path / "leaf.exr", leaf)
    bsdf = """<bsdf type="mask"><texture type="bitmap" name="opacity"><string name="filename"
      value="leaf.exr"/><boolean name="raw" value="true"/></texture>
      <bsdf type="principled" id="sheet"/></bsdf>"""
    (tmp_path / "scene.xml").write_text(
        f'<scene version="3.0.0"><shape type="rectangle">{bsdf}</shape></scene>'
    )
    views = SeenFrom(-np.inf)
    one = baked_of(tmp_path / "scene.xml", views, 2.0, refine=True, known=True)["sheet"]
    assert one.atlas.resolution == 64 and not one.coarse and not one.blends
    assert 0.99 < one.known_near["opacity"] < 1


def test_thin_blades_do_not_vanish(tmp_path):
    """They are 3 % of a sheet, and lie between the places where texels are looked up at first."""
    column = np.arange(1024) % 256
    grass = np.broadcast_to((column >= 45) & (column < 52), (4, 1024))
    write_exr(tmp_path / "grass.exr", grass.astype(np.float32))
    bsdf = f'<bsdf type="mask">{opacity_of("grass.exr")}<bsdf type="principled" id="sheet"/></bsdf>'
    (tmp_path / "scene.xml").write_text(
        f'<scene version="3.0.0"><shape type="rectangle">{bsdf}</shape></scene>'
    )
    coarse, fine = (
        baked_of(tmp_path / "scene.xml", SeenFrom(-np.inf), 2.0, refine=refine, known=True)["sheet"]
        for refine in (False, True)
    )
    assert (coarse.opacity < 0.5).all() and coarse.coarse == ["opacity"]
    assert (fine.opacity >= 0.5).mean() > 0.02 and not fine.coarse


@pytest.mark.parametrize("value", [0.7, 5.0])
def test_textures_of_one_number_stay_small(value, cut):
    """Rounding is no detail."""
    one = baked_of(cut, SeenFrom(-np.inf), 2.0)["leaves paint"]
    picture = mi.Bitmap(np.full((16, 16, 3), value, np.float32))
    texture = mi.load_dict({"type": "bitmap", "bitmap": picture, "raw": True})
    pixels, is_near = bake_texture(one, texture, colour=False, refine=True)
    assert is_near and len(pixels) == one.atlas.resolution == 64
    np.testing.assert_allclose(pixels, value, rtol=1e-5)


def test_all_materials_are_looked_up_by_one_kernel():
    texture = mi.load_dict({"type": "uniform", "value": 0.5})
    own = {material: dict.fromkeys(QUANTITIES, texture) for material in range(3)}
    number = dr.opaque(mi.UInt32, 1, 64)
    hashes = set()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        for material in own:
            si = dr.zeros(mi.SurfaceInteraction3f, 64)
            si.uv = mi.Point2f(dr.opaque(mi.Float, 0.3, 64))
            dr.kernel_history_clear()
            found = look_up(None, own, (material,), si, number, None, mi.Bool(True))
            dr.eval(found)
            hashes.add(tuple(k["hash"] for k in dr.kernel_history([dr.KernelType.JIT])))
            is_one = np.array(found["metallic"][0]) == (0.5 if material == 1 else 0)
            assert is_one.all()
    assert len(hashes) == 1


def test_what_is_finer_than_texels_is_averaged(cut):
    one = baked_of(cut, SeenFrom(-np.inf), 2.0)["leaf paint"]
    columns = np.broadcast_to(np.arange(128) % 2, (128, 128)).astype(np.float32)
    picture = {"bitmap": mi.Bitmap(columns), "raw": True, "filter_type": "nearest"}
    texture = mi.load_dict({"type": "bitmap", **picture})
    pixels, is_near = bake_texture(one, texture, colour=False)
    assert one.atlas.resolution == 64 and not is_near
    np.testing.assert_allclose(pixels, 0.5, atol=1e-6)


def test_a_moved_bump_map_is_as_fine_as_in_the_scene(tmp_path):
    texture = striped("bumps", "arbitrary", tmp_path)
    bsdf = f'<bsdf type="bumpmap" id="sheet">{texture}<bsdf type="principled"/></bsdf>'
    text = f'<scene version="3.0.0">{bsdf}{two_sheets("sheet")}<emitter type="constant"/></scene>'
    (tmp_path / "scene.xml").write_text(text)
    sizes = {}
    for refine in (False, True):
        out = tmp_path / f"out-{refine}"
        notes = rewritten(tmp_path / "scene.xml", out, 2.0, refine=refine).notes
        told = "sheet: its bump map is coarser than in the scene; a larger --texels keeps more"
        assert (told in notes) == (not refine)
        (file,) = out.rglob("*_texture-0.exr")
        sizes[refine] = len(read_exr(file))
    assert sizes == {False: 64, True: 512}


def test_textures_rise_within_one_budget(exported, tmp_path, monkeypatch):
    """All are counted before the first one rises, and not only those before it."""
    exported.use(monkeypatch)
    as_if_seen(monkeypatch)
    monkeypatch.setattr("unbake.exports.unwrap.SMALLEST", 16)
    # As if the fields had detail without end.
    monkeypatch.setattr("unbake.exports.bake.WANTED", 1.1)
    total = {}
    for most in (0, 6000):
        monkeypatch.setattr("unbake.exports.bake._MOST", most)
        out, words = tmp_path / f"{most}", {"tell": lambda line: None}
        told = exporting.export(exported.run, out, ["textures"], **words)
        total[most] = sum(row["resolution"] ** 2 for row in told["materials"])
    assert total[0] < total[6000] <= 6000


BRUSHED = """<bsdf type="blendbsdf" id="sheet"><float name="weight" value="0.5"/>
  <bsdf type="diffuse"/><bsdf type="roughconductor"><float name="alpha_u" value="0.1"/>
  <float name="alpha_v" value="{}"/></bsdf></bsdf>"""
TURNED = '<bsdf type="principled" id="sheet"><float name="anisotropic" value="{}"/></bsdf>'


@pytest.mark.parametrize(
    ("bsdf", "told"),
    [
        (TURNED.format(0.7), True),
        (TURNED.format(0.0), False),
        (BRUSHED.format(0.4), True),
        (BRUSHED.format(0.1), False),
    ],
)
def test_highlights_that_turn_with_the_coordinates_are_told(bsdf, told, tmp_path):
    text = f'<scene version="3.0.0">{bsdf}{two_sheets("sheet")}<emitter type="constant"/></scene>'
    (tmp_path / "scene.xml").write_text(text)
    notes = rewritten(tmp_path / "scene.xml", tmp_path / "out", 10.0).notes
    assert any("anisotropic highlights follow" in note for note in notes) == told


def test_what_no_view_saw_is_told_by_area(tmp_path):
    """Of two squares beside each other, one has seven eighths of the texels."""
    x, y = (axis.ravel() for axis in np.meshgrid([-1, 0, 1], [0, 1]))
    u = np.interp(x, [-1, 0, 1], [0, 7 / 8, 1])
    faces = np.array([(0, 1, 3), (1, 4, 3), (1, 2, 4), (2, 5, 4)], np.uint32)
    write_mesh(tmp_path / "sheet.ply", np.stack([x, y, 0 * x], -1), faces, uv=np.stack([u, y], -1))
    (tmp_path / "scene.xml").write_text(
        """<scene version="3.0.0"><shape type="ply"><string name="filename" value="sheet.ply"/>
          <bsdf type="diffuse"/></shape><emitter type="constant"/></scene>"""
    )
    found = read_parts(tmp_path / "scene.xml", tmp_path)
    own = own_textures(parsed_principled(tmp_path / "scene.xml", tmp_path), ())
    (atlas,) = make_atlases(found.scene, found.parts, 10.0)
    baked = Baker(None, own, SeenFrom(0)).bake(atlas)
    assert atlas.method == "own"
    assert (~baked.observed[baked.covered]).mean() == pytest.approx(7 / 8, abs=0.01)
    assert baked.unobserved_share == pytest.approx(0.5, abs=0.01)


LAYERS = """<scene version="3.0.0">
  <bsdf type="mask" id="layers">
    <texture type="bitmap" name="opacity"><string name="filename" value="metal.exr"/>
      <boolean name="raw" value="true"/><string name="filter_type" value="nearest"/></texture>
    <bsdf type="twosided"><bsdf type="normalmap">
      <texture type="bitmap" name="normalmap"><string name="filename" value="up.exr"/>
        <boolean name="raw" value="true"/></texture>
      <bsdf type="principled"><float name="metallic" value="0.25"/></bsdf></bsdf></bsdf></bsdf>
  <shape type="rectangle"><ref id="layers"/></shape>
  <shape type="rectangle"><ref id="layers"/><transform name="to_world"><translate z="-0.5"/>
    </transform></shape>
  <shape type="sphere"><float name="radius" value="0.1"/><bsdf type="conductor"/>
    <point name="center" x="0" y="0" z="2"/></shape>
  <emitter type="constant"/></scene>"""


def test_other_textures_of_unwrapped_materials_move_along(mixed, tmp_path, monkeypatch):
    (tmp_path / "scene").mkdir()
    shutil.copy(mixed.parent / "metal.exr", tmp_path / "scene")
    write_exr(tmp_path / "scene" / "up.exr", np.full((4, 4, 3), (0.5, 0.5, 1.0)))
    (tmp_path / "scene" / "scene.xml").write_text(LAYERS)
    data = grey_data(tmp_path / "scene" / "scene.xml", tmp_path / "data")
    fit(data, tmp_path / "run", replace(tiny_fields("grid"), method="direct", steps=0))
    options = {"texels": 100.0, "tell": lambda line: None}
    manifest = exporting.export(tmp_path / "run", tmp_path / "out", ["mitsuba"], **options)
    assert any("the normal map is left out" in note for note in manifest["notes"])
    written = mi.load_file(str(tmp_path / "out" / "mitsuba" / "scene.xml"), optimize=False)
    original = parsed_principled(data / "scene.xml", data).instantiate(merge=False)
    x = np.random.default_rng(0).uniform(-1, 1, (2, 1000)).astype(np.float32)
    ray = mi.Ray3f(mi.Point3f(*x, 1), mi.Vector3f(0, 0, -1))
    a, b = original.ray_intersect(ray), written.ray_intersect(ray)
    truth, found = (np.array(si.bsdf().eval_null_transmission(si))[0] for si in (a, b))
    assert np.ptp(truth) > 0.5 and (np.abs(found - truth) < 0.01).mean() > 0.95
    assert written.sensors(), "one is added where there is none"
    assert '"metallic" value="0.25"' in (tmp_path / "out/mitsuba/scene.xml").read_text()


FLAT = """<bsdf type="bumpmap" id="{}"><texture type="bitmap" name="arbitrary">
  <string name="filename" value="flat.exr"/><boolean name="raw" value="true"/></texture>{}</bsdf>"""
WALL = """<shape type="ply"><string name="filename" value="wall.ply"/><ref id="{}"/>
  <transform name="to_world"><translate x="{}" y="{}"/></transform></shape>"""
#: Walls whose texture runs upwards, with a flat bump map: one in coordinates of its own, two that
#: are unwrapped, and two of known metal.
WALLS = f"""<scene version="3.0.0">
  {FLAT.format("plaster", '<bsdf type="principled"/>')}
  {FLAT.format("paper", '<bsdf type="principled"/>')}
  {FLAT.format("steel", '<bsdf type="roughconductor"/>')}
  {WALL.format("plaster", 0, 0)}{WALL.format("paper", 3, 0)}{WALL.format("paper", 3, 1)}
  {WALL.format("steel", 6, 0)}
  <shape type="rectangle"><ref id="steel"/><transform name="to_world">
    <matrix value="0 -1 0 9  0 0 -1 0  1 0 0 0  0 0 0 1"/></transform></shape>
  <emitter type="constant"/></scene>"""


def test_flat_bump_maps_are_numbers_in_mitsuba_alone(tmp_path):
    scene = tmp_path / "scene" / "scene.xml"
    write_exr(scene.parent / "flat.exr", np.full((4, 4), 0.5))
    corners = np.array([(1, 0, -1), (1, 0, 1), (-1, 0, 1), (-1, 0, -1)])
    uv = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
    write_mesh(scene.parent / "wall.ply", corners, np.array([(0, 1, 2), (0, 2, 3)]), uv=uv)
    scene.write_text(WALLS)
    data = grey_data(scene, tmp_path / "data")
    fit(data, tmp_path / "run", replace(tiny_fields("grid"), method="direct", steps=0))
    options = {"texels": 20.0, "tell": lambda line: None}
    manifest = exporting.export(tmp_path / "run", tmp_path / "out", ["mitsuba"], **options)
    rows = {row["name"]: row["coordinates"] for row in manifest["materials"]}
    assert sorted(rows.values()) == ["own", "uvunwrap"]
    places = np.random.default_rng(0).uniform(-0.95, 0.95, (2, 2000)).astype(np.float32)

    def share_lit(file, x):
        walls = mi.load_file(str(file), optimize=False)
        ray = mi.Ray3f(mi.Point3f(places[0] + x, -4, places[1]), mi.Vector3f(0, 1, 0))
        si = walls.ray_intersect(ray)
        assert np.array(si.is_valid()).all()
        value = si.bsdf().eval(mi.BSDFContext(), si, dr.normalize(mi.Vector3f(0.2, 0.1, 1)))
        return (np.array(value) > 0).all(0).mean()  # of a metal they are black

    for x in (0, 3, 6, 9):
        assert share_lit(data / "scene.xml", x) < 0.9, "Mitsuba has mended it"
        assert share_lit(tmp_path / "out" / "mitsuba" / "scene.xml", x) == 1, x
    # Charts are turned by more than rounding hides in small ones.
    found = read_parts(scene, scene.parent)
    (paper,) = (a for a in make_atlases(found.scene, found.parts, 2.0) if a.method == "uvunwrap")
    for placed in paper.placed:
        a, b, c = placed.triangles.uv[placed.triangles.faces[0]]
        sides = np.abs([b - a, c - a, c - b])
        assert (sides.min(1) / sides.max(1)).min() > 5e-4


#: BSDFs around others, glass among them.
AROUND = """<scene version="3.0.0">
  <shape type="rectangle" id="fence"><bsdf type="mask"><float name="opacity" value="0.5"/>
    <bsdf type="bumpmap"><texture type="bitmap" name="arbitrary">
      <string name="filename" value="bump.exr"/></texture>
      <bsdf type="principled"/></bsdf></bsdf></shape>
  <shape type="rectangle" id="tiles"><bsdf type="normalmap">
    <rgb name="normalmap" value="0.5 0.5 1"/><bsdf type="diffuse"/></bsdf></shape>
  <shape type="rectangle" id="pane"><bsdf type="mask"><float name="opacity" value="0.5"/>
    <bsdf type="conductor"/></bsdf></shape>
  <shape type="rectangle" id="grille"><bsdf type="mask">
    <texture type="checkerboard" name="opacity"/><bsdf type="conductor"/></bsdf></shape>
  <shape type="rectangle" id="rust"><bsdf type="blendbsdf"><float name="weight" value="0.5"/>
    <bsdf type="diffuse"/><bsdf type="conductor"/></bsdf></shape>
  <shape type="rectangle" id="floor"><bsdf type="diffuse"/></shape></scene>"""


def masked(name, opacity):
    return f'''<bsdf type="mask" id="{name}">{opacity}<bsdf type="twosided">
      <bsdf type="principled" id="{name} paint"><texture type="bitmap" name="base_color">
        <string name="filename" value="leaf.exr"/><string name="filter_type" value="nearest"/>
      </texture></bsdf></bsdf></bsdf>'''


def opacity_of(file):
    return f'''<texture type="bitmap" name="opacity"><string name="filename" value="{file}"/>
      <boolean name="raw" value="true"/><string name="filter_type" value="nearest"/></texture>'''


#: A leaf of which there is a half, on one square and on two; a veil; and glass that is painted.
CUT = f"""<scene version="3.0.0">
  {masked("leaf", opacity_of("half.exr"))}{masked("leaves", opacity_of("half.exr"))}
  {masked("veil", '<float name="opacity" value="0.3"/>')}{masked("fog", opacity_of("fog.exr"))}
  <shape type="rectangle" id="one"><ref id="leaf"/></shape>{two_sheets("leaves", 3)}
  <shape type="rectangle" id="hung"><ref id="veil"/>
    <transform name="to_world"><translate y="3"/></transform></shape>
  <shape type="rectangle" id="misty"><ref id="fog"/>
    <transform name="to_world"><translate y="6"/></transform></shape>
  <shape type="rectangle" id="pane"><bsdf type="mask"><float name="opacity" value="0.25"/>
    <bsdf type="conductor"/></bsdf></shape>
  <emitter type="constant"/></scene>"""
GREEN = (0.1, 0.6, 0.2)


@pytest.fixture(scope="module")
def cut(tmp_path_factory) -> Path:
    """The file of a scene with cut-outs, black in their holes."""
    folder = tmp_path_factory.mktemp("cut")
    half = np.zeros((8, 8))
    half[:, 4:] = 1
    write_exr(folder / "half.exr", half)
    write_exr(folder / "leaf.exr", half[..., None] * np.array(GREEN))
    write_exr(folder / "fog.exr", 0.3 + 0.4 * half)
    (folder / "scene.xml").write_text(CUT)
    return folder / "scene.xml"


def baked_of(file, views, texels=20.0, **words):
    """All materials of a scene as they are there, by name."""
    found = read_parts(file, file.parent)
    atlases = make_atlases(found.scene, [p for p in found.parts if p.is_optimized], texels)
    own = own_textures(parsed_principled(file, file.parent), (), stored=True)
    masks = {mask for part in found.parts for mask in part.masks}
    opacities = own_opacities(parsed_principled(file, file.parent), masks)
    baker = Baker(None, own, views, opacities)
    return {atlas.name: baker.bake(atlas, **words) for atlas in atlases}


def test_holes_are_no_surface(cut):
    """Nobody sees them, they count in no share, and their colours are those of the rim."""
    baked = baked_of(cut, SeenFrom(-np.inf))
    assert baked["leaf paint"].atlas.method == "own"
    assert baked["leaves paint"].atlas.method == "uvunwrap"
    for name in ("leaf paint", "leaves paint"):
        one = baked[name]
        solid = one.opacity > 0.5
        assert not one.observed[one.opacity == 0].any() and one.observed[one.opacity == 1].any()
        assert one.unobserved_share == 0 and not one.blends
        off = np.abs(one.values["albedo"] - GREEN).max(-1)
        assert off.max() < 1e-4, "of the leaf alone, also in its holes"
        share = solid.mean() if name == "leaf paint" else solid[one.covered].mean()
        assert share > 0.4
    for name in ("veil paint", "fog paint"):  # transparent to a part, and seen
        assert baked[name].blends and baked[name].observed[baked[name].covered].all()
    assert baked["veil paint"].constant_opacity == pytest.approx(0.3, abs=1e-5)
    assert baked["fog paint"].constant_opacity is None
    assert baked_of(cut, SeenFrom(np.inf))["leaf paint"].unobserved_share == 1


def test_curtains_beside_walls_of_their_material_are_seen(tmp_path):
    """What is transparent to a part is blended, however small it is beside what is solid."""
    fog = {"low": 0.3, "high": 0.4}
    places = {"wall": ("paint", 0, 5), "curtain": ("veil", 11, 0.5), "steam": ("fog", 13, 0.5),
              "board": ("cover", 19, 5)}  # fmt: skip
    shapes = [
        f"""<shape type="rectangle" id="{name}"><ref id="{bsdf}"/><transform name="to_world">
          <scale value="{scale}"/><translate x="{x}"/></transform></shape>"""
        for name, (bsdf, x, scale) in places.items()
    ]
    (tmp_path / "scene.xml").write_text(
        f"""<scene version="3.0.0"><bsdf type="principled" id="paint"/>
          <bsdf type="principled" id="cover"/>
          <bsdf type="mask" id="veil"><float name="opacity" value="0.3"/><ref id="paint"/></bsdf>
          <bsdf type="mask" id="fog">{striped("fog", "opacity", tmp_path, **fog)}
            <ref id="cover"/></bsdf>{"".join(shapes)}</scene>"""
    )
    baked = baked_of(tmp_path / "scene.xml", SeenFrom(-np.inf), 2.0)
    found = {placed.part.name: one for one in baked.values() for placed in one.atlas.placed}
    assert found["wall"].opacity is None and not found["wall"].blends
    assert found["curtain"].blends and found["curtain"].covered.all()
    assert found["curtain"].constant_opacity == pytest.approx(0.3, abs=1e-5)
    shared = found["steam"]
    assert shared is found["board"] and shared.blends and shared.opacity.max() == 1
    assert shared.known_near == {} and shared.opacity.min() == pytest.approx(0.3, abs=1e-5)


@pytest.fixture(scope="module")
def cut_out(cut, tmp_path_factory) -> tuple[Path, dict]:
    """The scene with cut-outs, exported to all formats; and what is told of it."""
    folder = tmp_path_factory.mktemp("cut-out")
    data = grey_data(cut, folder / "data")
    fit(data, folder / "run", replace(tiny_fields("grid"), method="direct", steps=0))
    options = {"texels": 20.0, "tell": lambda line: None}
    formats = ["gltf", "usd", "textures"]
    return folder / "out", exporting.export(folder / "run", folder / "out", formats, **options)


def test_gltf_has_cut_outs(cut_out):
    folder, manifest = cut_out
    made = {m["name"]: m for m in document_of(folder / "scene.glb")["materials"]}
    assert {name: m.get("alphaMode") for name, m in made.items()} == {
        "leaf paint": "MASK", "leaves paint": "MASK", "veil paint": "BLEND", "fog paint": "BLEND",
        "pane": "BLEND",
    }  # fmt: skip
    assert {m.get("alphaCutoff") for m in made.values()} == {0.5, None}
    for name, opacity in (("veil paint", 0.3), ("pane", 0.25)):
        factor = made[name]["pbrMetallicRoughness"]["baseColorFactor"]
        assert factor[3] == pytest.approx(opacity, abs=1e-5)
    assert not any("cut-outs" in note for note in manifest["notes"])
    loaded = trimesh.load(folder / "scene.glb")
    rng = np.random.default_rng(0)
    for name, least, most in (("one", 0, 255), ("misty", 0.3 * 255, 0.7 * 255)):
        picture = loaded.geometry[name].visual.material.baseColorTexture
        assert picture.mode == "RGBA"
        uv = rng.uniform(0.05, 0.95, (500, 2))
        uv = uv[np.abs(uv[:, 0] - 0.5) > 0.05]
        wanted = np.where(uv[:, 0] < 0.5, least, most)
        assert np.abs(looked_up(picture, uv)[:, 3] - wanted).max() <= 1
        assert np.array(picture)[..., :3].min() > 50, "colours are not multiplied by it"
    rows = {row["name"]: row for row in manifest["materials"]}
    file = next(f for f in rows["leaf paint"]["textures"] if f.endswith("_opacity.exr"))
    assert set(np.unique(read_exr(folder / "textures" / file))) == {0, 1}


def test_khronos_finds_nothing_wrong_with_cut_outs(cut_out, judges):
    lacks = judges["validator_lacks"]()
    if lacks is not None:
        pytest.skip(lacks)
    report = judges["validated"](cut_out[0] / "scene.glb")
    assert report["numErrors"] == report["numWarnings"] == 0, report["messages"]


def test_usd_has_cut_outs(cut_out):
    from pxr import Usd, UsdShade

    stage = Usd.Stage.Open(str(cut_out[0] / "usd" / "scene.usdc"))
    surfaces = {
        prim.GetDisplayName(): UsdShade.Material(prim).ComputeSurfaceSource()[0]
        for prim in stage.Traverse()
        if prim.IsA(UsdShade.Material)
    }
    for name in ("leaf paint", "leaves paint", "fog paint"):
        surface = surfaces[name]
        threshold = surface.GetInput("opacityThreshold")
        assert (threshold.Get() if threshold else None) == (None if "fog" in name else 0.5)
        (source,) = surface.GetInput("opacity").GetConnectedSources()[0]
        assert source.sourceName == "a"
        file = UsdShade.Shader(source.source.GetPrim()).GetInput("file").Get().resolvedPath
        assert np.ptp(as_pixels(file)[..., 3]) > 100
    assert surfaces["veil paint"].GetInput("opacity").Get() == pytest.approx(0.3)
    assert surfaces["pane"].GetInput("opacity").Get() == pytest.approx(0.25)


#: A sheet whose corners have colours, and one below whose triangles have.
COLOURED = """<scene version="3.0.0">
  <bsdf type="principled" id="dyed"><texture type="mesh_attribute" name="base_color">
    <string name="name" value="vertex_color"/></texture></bsdf>
  <bsdf type="principled" id="tiled"><texture type="mesh_attribute" name="base_color">
    <string name="name" value="face_color"/></texture></bsdf>
  <shape type="ply" id="sheet"><string name="filename" value="vertex.ply"/><ref id="dyed"/></shape>
  <shape type="ply" id="tiles"><string name="filename" value="face.ply"/><ref id="tiled"/>
    <transform name="to_world"><translate x="3"/></transform></shape>
  <emitter type="constant"/></scene>"""
COLOURS = ("0.9 0.1 0.1", "0.1 0.9 0.1", "0.1 0.1 0.9", "0.9 0.9 0.1")


def write_coloured(folder, kind, *, own):
    """A square of two triangles as PLY; with texture coordinates, or without."""
    of_vertex, of_face = (
        [f" {c}" if kind == each else "" for c in COLOURS] for each in ("vertex", "face")
    )
    channels = [f"property float {name}" for name in ("red", "green", "blue")]
    corners = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    uv = [f" {(x + 1) / 2} {(y + 1) / 2}" if own else "" for x, y in corners]
    lines = [
        "ply", "format ascii 1.0", "element vertex 4",
        *(f"property float {name}" for name in ("x", "y", "z", *("uv" if own else ""))),
        *(channels if kind == "vertex" else []), "element face 2",
        "property list uchar int vertex_indices", *(channels if kind == "face" else []),
        "end_header",
        *(f"{x} {y} 0{at}{c}" for (x, y), at, c in zip(corners, uv, of_vertex, strict=True)),
        *(f"3 {face}{c}" for face, c in zip(("0 1 2", "0 2 3"), of_face, strict=False)),
    ]  # fmt: skip
    (folder / f"{kind}.ply").write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("own", [True, False])
@pytest.mark.parametrize("unknown", ["lighting", "materials"])
def test_colours_stored_in_meshes_become_textures(unknown, own, tmp_path):
    """Where they were known: the albedo of a fit that finds light, or roughness alone."""
    scene = tmp_path / "scene" / "scene.xml"
    scene.parent.mkdir()
    for kind in ("vertex", "face"):
        write_coloured(scene.parent, kind, own=own)
    scene.write_text(COLOURED)
    data = grey_data(scene, tmp_path / "data")
    config = replace(tiny_fields("grid"), method="direct", unknown=unknown, steps=0)
    fit(data, tmp_path / "run", replace(config, quantities=("roughness",)))
    options = {"texels": 60.0, "tell": lambda line: None}
    formats = ["gltf", "mitsuba", "textures"]
    manifest = exporting.export(tmp_path / "run", tmp_path / "out", formats, **options)
    assert {row["coordinates"] for row in manifest["materials"]} == {"own" if own else "uvunwrap"}
    original = parsed_principled(data / "scene.xml", data).instantiate(merge=False)
    written = mi.load_file(str(tmp_path / "out" / "mitsuba" / "scene.xml"), optimize=False)
    geometry = trimesh.load(tmp_path / "out" / "scene.glb").geometry
    places = np.random.default_rng(0).uniform(-0.95, 0.95, (2, 400)).astype(np.float32)
    places = places[:, np.abs(places[0] - places[1]) > 0.1]
    for name, at in (("sheet", 0), ("tiles", 3)):
        ray = mi.Ray3f(mi.Point3f(places[0] + at, places[1], 1), mi.Vector3f(0, 0, -1))
        truth, found = (
            np.array(si.bsdf().eval_diffuse_reflectance(si)).T
            for si in (original.ray_intersect(ray), written.ray_intersect(ray))
        )
        assert np.ptp(truth) > 0.5 and np.abs(found - truth).max() < 0.01, name
        points = np.stack([places[0] + at, places[1], 0 * places[0]], -1)
        faces = (places[0] < places[1]).astype(int)
        mesh = geometry[name]
        weights = trimesh.triangles.points_to_barycentric(mesh.triangles[faces], points)
        uv = np.einsum("nk,nkd->nd", weights, mesh.visual.uv[mesh.faces[faces]]) * [1, -1] + [0, 1]
        colour = looked_up(mesh.visual.material.baseColorTexture.convert("RGB"), uv)
        assert np.abs(colour - 255 * srgb(truth)).max() <= 3, name


@pytest.mark.parametrize("kind", ["gltf", "usd", "mitsuba"])
def test_layers_of_materials_that_are_left_out_are_told(kind, tmp_path):
    write_exr(tmp_path / "bump.exr", np.zeros((4, 4)))
    (tmp_path / "scene.xml").write_text(AROUND)
    found = read_parts(tmp_path / "scene.xml", tmp_path)
    notes = exporting._without_place(found, [], [kind], [])
    told = {
        "cut-outs of materials without textures": "grille",
        "bump maps": "fence",
        "normal maps": "tiles",
        "blends of materials": "rust",
    }
    lost = [
        f"unbake does not write {name} to glTF and usd: left out of {of}"
        for name, of in told.items()
    ]
    assert sorted(notes) == ([] if kind == "mitsuba" else sorted(lost))


@pytest.mark.parametrize("kind", ["gltf", "mitsuba"])
def test_lights_that_other_formats_do_not_have_are_told(kind, tmp_path):
    (tmp_path / "scene.xml").write_text(
        """<scene version="3.0.0"><shape type="rectangle"><bsdf type="principled"/></shape>
          <emitter type="projector" id="beamer"><texture type="checkerboard" name="irradiance"/>
          </emitter><emitter type="point"/><emitter type="constant"/></scene>"""
    )
    found = read_parts(tmp_path / "scene.xml", tmp_path)
    told = ["unbake does not write such lights to glTF and usd: beamer"] if kind == "gltf" else []
    assert exporting._without_place(found, [], [kind], []) == told


@pytest.mark.parametrize(("rows", "kept"), [(16, 256), (400, 400), (1100, 1024)])
def test_the_picture_of_a_known_environment_is_about_as_large(rows, kept):
    picture = mi.Bitmap(np.ones((rows, 2 * rows, 3), np.float32))
    scene = mi.load_dict({"type": "scene", "light": {"type": "envmap", "bitmap": picture}})
    problem = SimpleNamespace(environment=None, scene_view=SimpleNamespace(scene=scene))
    assert environment_picture(problem).shape == (kept, 2 * kept, 3)


@pytest.mark.parametrize("lamps", ["known", "fitted"])
def test_what_was_learned_of_lamps_and_is_left_out_is_told(lamps, tmp_path):
    scene = tmp_path / "scene"
    scene.mkdir()
    (scene / "scene.xml").write_text(ENAMEL)
    data = grey_data(scene / "scene.xml", tmp_path / "data")
    config = replace(tiny_fields("grid"), method="direct", lamps=lamps, steps=0)
    fit(data, tmp_path / "run", config)
    for formats, told in ((["gltf", "textures"], lamps == "fitted"), (["mitsuba"], False)):
        out, lines = tmp_path / formats[0], []
        options = {"texels": 4.0, "tell": lines.append}
        notes = exporting.export(tmp_path / "run", out, formats, **options)["notes"]
        note = "what was learned of materials on lamps is in the scene for Mitsuba alone: "
        assert (f"{note}left out of bulb" in notes) == told
        assert (f"note: {note}left out of bulb" in lines) == told


LIGHT = """<emitter type="area"><texture type="bitmap" name="radiance">
    <string name="filename" value="picture.exr"/><boolean name="raw" value="true"/>
  </texture></emitter>"""
#: A floor, and two screens of its paint: the second one shows a half of the picture twice.
SCREENS = f"""<scene version="3.0.0">
  <bsdf type="diffuse" id="paint"/>
  <shape type="rectangle" id="floor"><ref id="paint"/>
    <transform name="to_world"><scale value="2"/><translate z="-1"/></transform></shape>
  <shape type="rectangle" id="screen"><ref id="paint"/>{LIGHT}
    <transform name="to_world"><scale value="0.5"/><translate x="-0.6"/></transform></shape>
  <shape type="ply" id="folded"><string name="filename" value="folded.ply"/>
    <ref id="paint"/>{LIGHT}</shape></scene>"""


@pytest.mark.parametrize("method", ["ours", "prb"])
def test_screens_of_meshes_keep_their_pictures_in_steps_that_are_replayed(method, tmp_path):
    folder = tmp_path / "scene"
    write_exr(folder / "picture.exr", np.random.default_rng(5).uniform(0.5, 4, (4, 6, 3)))
    corners = np.array([(0.1, -0.5, 0), (1.1, -0.5, 0), (1.1, 0.5, 0), (0.1, 0.5, 0)])
    uv = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
    write_mesh(folder / "folded.ply", corners, np.array([(0, 1, 2), (0, 2, 3)]), uv=uv)
    (folder / "scene.xml").write_text(SCREENS)
    data = grey_data(folder / "scene.xml", tmp_path / "data")
    config = replace(tiny_fields("grid"), method=method, unknown="emission", steps=4)
    progress = fit(data, tmp_path / "run", config)
    assert progress.step == 4
    emission = load_run(tmp_path / "run").problem.emission
    assert all(pattern is not None for pattern in emission.patterns)
    assert [pattern.sampled_by_it for pattern in emission.patterns] == [True, False]


@pytest.mark.parametrize("more", [0, 1, 2, 5])
def test_recovered_screens_keep_their_pictures(more, tmp_path, monkeypatch):
    folder, rng = tmp_path / "scene", np.random.default_rng(5)
    picture = rng.uniform(0.5, 4, (4, 6, 3)).astype(np.float32)
    write_exr(folder / "picture.exr", picture)
    screen = SCREENS[SCREENS.index('  <shape type="rectangle" id="screen">') :]
    screen = screen[: screen.index("</shape>")] + "</shape>"
    floor = SCREENS[: SCREENS.index('  <shape type="rectangle" id="screen">')]
    tiled = '<transform name="to_uv"><scale value="2"/></transform></texture>'
    other = screen.replace('"screen"', '"other"').replace("-0.6", "0.6")
    screens = screen + other.replace("</texture>", tiled)
    balls = '<shape type="sphere"><ref id="paint"/><point name="center" value="0,0,-3"/></shape>'
    (folder / "scene.xml").write_text(floor + screens + more * balls + "</scene>")
    data = grey_data(folder / "scene.xml", tmp_path / "data")
    config = replace(tiny_fields("grid"), method="direct", unknown="emission", steps=0)
    fit(data, tmp_path / "run", config)
    recovered, strength = load_run(tmp_path / "run"), np.array([3.0, 1.0, 0.5])
    emission = recovered.problem.emission
    logs = np.log(strength / emission.scale).astype(np.float32)
    emission.assign({"log": mi.Float(np.tile(logs, 2))})
    emission.prepare()
    monkeypatch.setattr(exporting, "load_run", lambda *_, **__: recovered)
    as_if_seen(monkeypatch)
    options = {"texels": 10.0, "tell": lambda line: None}
    manifest = exporting.export(tmp_path / "run", tmp_path / "out", ["mitsuba", "gltf"], **options)
    assert manifest["lights"][0]["strength"] == pytest.approx(list(strength), rel=1e-5)
    note = "lights with a picture have its mean in glTF and usd: screen, other"
    assert note in manifest["notes"]
    shown = picture / picture.mean((0, 1)) * strength
    written = read_exr(tmp_path / "out" / "mitsuba" / "lights" / "screen.exr")
    np.testing.assert_allclose(written[..., :3], shown, rtol=1e-4)
    scene = mi.load_file(str(tmp_path / "out" / "mitsuba" / "scene.xml"))
    x = rng.uniform((-1.1, -0.5), (-0.1, 0.5), (500, 2)).T
    x = np.concatenate([x, x + np.array([[1.2], [0]])], 1).astype(np.float32)
    ray = mi.Ray3f(mi.Point3f(*x, 1), mi.Vector3f(0, 0, -1))
    ours = recovered.problem.scene_view.scene
    a, b = (s.ray_intersect(ray).emitter(s).eval(s.ray_intersect(ray)) for s in (ours, scene))
    np.testing.assert_allclose(np.array(b), np.array(a), rtol=0.02, atol=0.02)
    assert np.array(a).std(1).min() > 0.1


def test_screens_keep_their_pictures_though_others_share_their_material(tmp_path, monkeypatch):
    folder, rng = tmp_path / "scene", np.random.default_rng(5)
    write_exr(folder / "picture.exr", rng.uniform(0.5, 4, (4, 4, 3)))
    corners = np.array([(0.1, -0.5, 0), (1.1, -0.5, 0), (1.1, 0.5, 0), (0.1, 0.5, 0)])
    uv = np.array([(0, 0), (1, 0), (1, 1), (1, 0)])
    write_mesh(folder / "folded.ply", corners, np.array([(0, 1, 2), (0, 2, 3)]), uv=uv)
    (folder / "scene.xml").write_text(SCREENS)
    data = grey_data(folder / "scene.xml", tmp_path / "data")
    fit(data, tmp_path / "run", replace(tiny_fields("grid"), method="direct", steps=0))
    recovered = load_run(tmp_path / "run")
    materials = recovered.problem.materials
    materials.assign(random_values(materials, 1))
    monkeypatch.setattr(exporting, "load_run", lambda *_, **__: recovered)
    as_if_seen(monkeypatch)
    options = {"texels": 100.0, "tell": lambda line: None}
    manifest = exporting.export(tmp_path / "run", tmp_path / "out", ["mitsuba"], **options)
    (paint,) = manifest["materials"]
    assert paint["name"] == "paint" and paint["parts"] == ["floor"]
    assert paint["area"] == pytest.approx(16)
    written = mi.load_file(str(tmp_path / "out" / "mitsuba" / "scene.xml"), optimize=False)
    original = parsed_principled(data / "scene.xml", data).instantiate(merge=False)
    places = {
        "floor": ((-1.9, 0.6), (1.9, 1.9), 0.0),
        "screen": ((-1.1, -0.5), (-0.1, 0.5), 1e-3),
        "folded": ((0.1, -0.5), (1.1, 0.5), 0.1),
    }
    for name, (low, high, most) in places.items():
        x = np.ascontiguousarray(rng.uniform(low, high, (1000, 2)).T, np.float32)
        ray = mi.Ray3f(mi.Point3f(*x, 1), mi.Vector3f(0, 0, -1))
        a, b = original.ray_intersect(ray), written.ray_intersect(ray)
        truth, found = (
            np.array(si.emitter(scene).eval(si)) for si, scene in ((a, original), (b, written))
        )
        assert np.ptp(truth) > 0.5 or name == "floor"
        assert (np.abs(found - truth).max(0) <= most).mean() > 0.97, name
        albedo = material_at(recovered, np.array(a.p).T)["albedo"]
        shown = np.array(b.bsdf().eval_diffuse_reflectance(b)).T
        assert np.ptp(albedo) > 0.1, name
        assert (np.abs(shown - albedo).max(1) < 0.02).mean() > 0.95, name


def test_bitmaps_are_looked_up_in_the_coordinates_of_the_scene(mixed, tmp_path, monkeypatch):
    config = replace(tiny_fields("bitmap"), method="direct", steps=0)
    # Those without texture coordinates cannot have bitmaps.
    text = re.sub(r'<shape type="ply">.*?</shape>', "", SCENE)
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "scene.xml").write_text(text)
    shutil.copy(mixed.parent / "metal.exr", tmp_path / "scene")
    data = grey_data(tmp_path / "scene" / "scene.xml", tmp_path / "data")
    fit(data, tmp_path / "run", config)
    recovered = load_run(tmp_path / "run")
    materials, scene = recovered.problem.materials, recovered.problem.scene_view.scene
    assert materials is not None
    materials.assign(random_values(materials, 1))
    monkeypatch.setattr(exporting, "load_run", lambda *_, **__: recovered)
    as_if_seen(monkeypatch)
    options = {"texels": 60.0, "tell": lambda line: None}
    exporting.export(tmp_path / "run", tmp_path / "out", ["mitsuba"], **options)
    written = mi.load_file(str(tmp_path / "out" / "mitsuba" / "scene.xml"), optimize=False)
    rays = recovered.dataset.train[0].camera.rays(
        *(np.random.default_rng(0).random((2, 2000)) * 16)
    )
    origin, d = (np.ascontiguousarray(x.T, np.float32) for x in rays)
    ray = mi.Ray3f(mi.Point3f(origin), mi.Vector3f(d))
    a, b = scene.ray_intersect(ray), written.ray_intersect(ray)
    truth = np.array(materials.evaluate(a, a.is_valid())["albedo"])
    found = np.array(b.bsdf().eval_diffuse_reflectance(b))
    painted = np.array(recovered.problem.scene_view.is_optimized(a.shape))
    assert painted.mean() > 0.3 and np.ptp(truth[:, painted]) > 0.3
    # Their texels have edges, which other texels blur.
    assert (np.abs(found - truth).max(0)[painted] < 0.02).mean() > 0.95


def test_own_coordinates_count_where_they_are_unique(mixed):
    found = read_parts(mixed, mixed.parent)
    ground = next(part for part in found.parts if part.name == "ground")
    uv = ground.triangles.uv
    methods = {}
    for name, given in {
        "unique": uv, "out of range": 3 * uv, "folded": np.abs(uv - 0.5), "none": None,
        "not a number": np.full_like(uv, np.nan), "a line": uv * [1, 0],
    }.items():  # fmt: skip
        triangles = replace(ground.triangles, uv=given)
        (atlas,) = make_atlases(found.scene, [replace(ground, triangles=triangles)], 10.0)
        methods[name] = atlas.method
        assert atlas.unique >= 0.999 and atlas.resolution == 64
    assert methods.pop("unique") == "own" and set(methods.values()) == {"uvunwrap"}
    # Two parts of one material in one place of the square.
    both = [ground, replace(ground, name="again")]
    moved = replace(ground.triangles, positions=ground.triangles.positions + np.float32(1))
    both[1] = replace(both[1], triangles=moved)
    (atlas,) = make_atlases(found.scene, both, 10.0)
    assert atlas.method == "uvunwrap" and len(atlas.placed) == 2


def test_xatlas_takes_over_where_uvunwrap_fails(mixed, monkeypatch):
    """Its page grows beyond what it is asked for, and the texels with it."""
    import uvunwrap
    import xatlas

    pages = []

    class Noted(xatlas.Atlas):
        def generate(self, *words):
            super().generate(*words)
            pages.append(max(self.width, self.height))

    monkeypatch.setattr(xatlas, "Atlas", Noted)

    def fails(*words, **named):
        raise uvunwrap.UnwrapError("it fails")

    monkeypatch.setattr(uvunwrap, "generate", fails)
    found = read_parts(mixed, mixed.parent)
    cloth = [part for part in found.parts if part.name in ("part", "part-2", "block")]
    (atlas,) = make_atlases(found.scene, cloth, 40.0)
    assert atlas.method == "xatlas" and atlas.unique >= 0.999
    assert unique_share(atlas.placed, seed=7) >= 0.999
    (crowded,) = make_atlases(found.scene, many_boxes(found), 0.5)
    assert crowded.method == "xatlas" and crowded.wanted <= 64 < pages[1] <= crowded.resolution
    assert pages[0] <= atlas.resolution and crowded.resolution < 2 * pages[1]
    uv = np.concatenate([placed.triangles.uv for placed in crowded.placed])
    assert uv.min() < 0.02 and uv.max(0) == pytest.approx([1, 1], abs=0.02)


def many_boxes(found):
    """300 parts of the material of the block, each of six charts."""
    block = next(part for part in found.parts if part.name == "block")
    rng = np.random.default_rng(0)
    return [
        replace(block, name=f"box-{i}", triangles=replace(
            block.triangles, uv=None,
            positions=block.triangles.positions + rng.uniform(-3, 3, 3).astype(np.float32),
        ))
        for i in range(300)
    ]  # fmt: skip


def test_many_charts_get_a_page_that_holds_them(mixed):
    found = read_parts(mixed, mixed.parent)
    (atlas,) = make_atlases(found.scene, many_boxes(found), 0.5)
    assert atlas.wanted <= 64 < atlas.resolution <= 512
    assert atlas.method == "uvunwrap" and atlas.unique >= 0.999


def test_charts_of_large_textures_are_further_apart(mixed):
    """As far as mipmaps that halve a texture three times keep them apart, at little cost."""
    found = read_parts(mixed, mixed.parent)
    (block, *_) = (part for part in found.parts if part.name == "block")
    (atlas,) = make_atlases(found.scene, [block], 4000.0)
    assert atlas.resolution >= 1024 and atlas.method == "uvunwrap"
    triangles = atlas.placed[0].triangles
    chart = np.arange(len(triangles.positions))  # vertices are split where charts meet
    for _ in chart:
        for face in triangles.faces:
            chart[face] = chart[face].min()
    along = np.linspace(0, 1, 50)[:, None]
    edges = {}
    for face in triangles.faces:
        for i, j in ((0, 1), (1, 2), (2, 0)):
            a, b = triangles.uv[face[i]], triangles.uv[face[j]]
            edges.setdefault(chart[face[0]], []).append(a + along * (b - a))
    edges = [np.concatenate(each) for each in edges.values()]
    assert len(edges) > 1
    gaps = [
        np.linalg.norm(one[:, None] - other[None], axis=-1).min()
        for i, one in enumerate(edges)
        for other in edges[:i]
    ]
    assert 0.9 / 128 < min(gaps) < 0.05
    corners = triangles.uv[triangles.faces]
    areas = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 2
    assert areas.sum() > 0.6


def test_a_scene_of_many_parts_is_exported_whole(tmp_path):
    """Sixty meshes, half of them of one material, the others with one each."""
    rng = np.random.default_rng(0)
    shapes = []
    for i in range(60):
        place = " ".join(
            f'{axis}="{x:.3f}"' for axis, x in zip("xyz", rng.uniform(-1, 1, 3), strict=True)
        )
        inside = '<ref id="shared"/>' if i % 2 else '<bsdf type="diffuse"/>'
        shapes.append(
            f'<shape type="cube" id="part-{i}">{inside}<transform name="to_world">'
            f'<scale value="0.05"/><translate {place}/></transform></shape>'
        )
    text = '<scene version="3.0.0"><bsdf type="diffuse" id="shared"/>'
    (tmp_path / "scene").mkdir()
    (tmp_path / "scene" / "scene.xml").write_text(
        text + "".join(shapes) + '<emitter type="constant"/></scene>'
    )
    data = grey_data(tmp_path / "scene" / "scene.xml", tmp_path / "data")
    fit(data, tmp_path / "run", replace(tiny_fields("grid"), method="direct", steps=0))
    options = {"texels": 20.0, "tell": lambda line: None}
    manifest = exporting.export(tmp_path / "run", tmp_path / "out", ["gltf"], **options)
    names = {f"part-{i}" for i in range(60)}
    assert {part["name"] for part in manifest["parts"]} == names
    assert len(manifest["materials"]) == 31 and not manifest["left_out"]
    assert max(len(row["parts"]) for row in manifest["materials"]) == 30
    assert all(row["unique_share"] >= 0.999 for row in manifest["materials"])
    loaded = trimesh.load(tmp_path / "out" / "scene.glb")
    assert set(loaded.geometry) == names
    assert {len(geometry.faces) for geometry in loaded.geometry.values()} == {12}


def test_resolutions_are_powers_of_two_within_limits(mixed):
    found = read_parts(mixed, mixed.parent)
    ground = [part for part in found.parts if part.name == "ground"]
    sizes = [make_atlases(found.scene, ground, texels)[0] for texels in (1.0, 100.0, 1e6)]
    assert [atlas.resolution for atlas in sizes] == [64, 512, 8192]
    assert sizes[0].wanted < 64 and sizes[2].wanted > 8192


def test_views_see_what_is_in_front_of_them(mixed):
    """The floor below the ball is hidden from above, its underside is seen from below alone."""
    scene = parsed_principled(mixed, mixed.parent).instantiate()
    above = LookAt((-0.7, 0.2, 3.0), (-0.7, 0.2, 0.0), (0, 1, 0), 50.0).camera(8, 8)
    places = [(-0.7, 0.2, 0), (0.1, 0.2, 0), (1.45, 1.1, 0), (0.1, 0.2, 0)]
    p = mi.Point3f(np.array(places, np.float32).T.copy())
    up = mi.Normal3f(0, 0, mi.Float([1, 1, 1, -1]))
    one, both = dr.zeros(mi.Bool, 4), dr.ones(mi.Bool, 4)
    views = Views(scene, [above])
    assert np.array(views.see(p, up, one, both)).tolist() == [False, True, False, False]
    assert np.array(views.see(p, up, both, both)).tolist() == [False, True, False, True]


@pytest.mark.parametrize("opacity", [0.2, 0.8])
@pytest.mark.parametrize("hidden", [True, False])
def test_views_see_through_holes_and_lamps_that_images_do_not_show(opacity, hidden):
    """A leaf hangs above the left point of a floor, and a lamp above the right one."""

    def square(x, z, **more):
        place = mi.ScalarTransform4f().translate([x, 0, z]).scale(0.4)
        return {"type": "rectangle", "to_world": place} | more

    leaf = {"type": "mask", "opacity": opacity, "bsdf": {"type": "diffuse"}}
    lamp = {"type": "area", "radiance": {"type": "rgb", "value": 1.0}}
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3)}
    shapes = [floor, square(-0.5, 0.5, bsdf=leaf), square(0.5, 0.5, emitter=lamp)]
    scene = mi.load_dict({"type": "scene"} | {f"shape{i}": s for i, s in enumerate(shapes)})
    above = LookAt((0, 0, 30), (0, 0, 0), (0, 1, 0), 10.0).camera(8, 8)
    p = mi.Point3f(np.array([(-0.5, 0, 0), (0.5, 0, 0), (0, 1.5, 0)], np.float32).T.copy())
    up, both = mi.Normal3f(0, 0, mi.Float([1, 1, 1])), dr.ones(mi.Bool, 3)
    seen = np.array(Views(scene, [above], hide_emitters=hidden).see(p, up, ~both, both))
    assert seen.tolist() == [opacity < 0.5, hidden, True]


def test_cameras_are_asked_until_all_is_seen(mixed, monkeypatch):
    scene = parsed_principled(mixed, mixed.parent).instantiate()
    above = LookAt((-0.7, 0.2, 3.0), (-0.7, 0.2, 0.0), (0, 1, 0), 50.0).camera(8, 8)
    away = above.moved(np.array([0.0, 3.0, 0.0]), np.zeros(3))
    asked, sees = [], Views._sees
    monkeypatch.setattr(
        Views, "_sees", lambda self, n, *rest: asked.append(n) or sees(self, n, *rest)
    )
    p = mi.Point3f(np.array([(-1.3, 0.2, 0), (0.1, 0.2, 0)], np.float32).T.copy())
    up, both = mi.Normal3f(0, 0, mi.Float([1, 1])), dr.ones(mi.Bool, 2)
    views = Views(scene, [away, above, away])
    assert np.array(views.see(p, up, ~both, both)).all() and asked == [0, 1]
    assert not np.array(views.see(p, up, ~both, ~both)).any() and asked == [0, 1]


def test_views_see_nothing_in_pixels_that_do_not_count(mixed):
    """One floor point left and one right of the middle, and masks of either half."""
    scene = parsed_principled(mixed, mixed.parent).instantiate()
    above = LookAt((-0.7, 0.2, 3.0), (-0.7, 0.2, 0.0), (0, 1, 0), 50.0).camera(8, 8)
    p = mi.Point3f(np.array([(-1.3, 0.2, 0), (0.1, 0.2, 0)], np.float32).T.copy())
    up, both = mi.Normal3f(0, 0, mi.Float([1, 1])), dr.ones(mi.Bool, 2)
    right, asked = np.zeros((8, 8), bool), []
    right[:, 4:] = True
    for counted, expected in (
        (None, [True, True]),
        (right, [False, True]),
        (~right, [True, False]),
        (np.zeros((8, 8), bool), [False, False]),
    ):
        images = [None, counted]

        def count(number, images=images):
            asked.append(number)
            return images[number]

        # The first camera looks away, and its image is not asked for.
        away = above.moved(np.array([0.0, 3.0, 0.0]), np.zeros(3))
        views = Views(scene, [away, above], count)
        for _ in range(2):
            assert np.array(views.see(p, up, ~both, both)).tolist() == expected
    assert asked == [1] * 4


def test_what_is_masked_in_all_photographs_is_unobserved(exported, tmp_path):
    """And so is what none shows in front of a hidden background."""
    recovered, dataset = exported.recovered, exported.recovered.dataset
    write_exr(tmp_path / "clear.exr", np.zeros((16, 16, 4), np.float32))
    write_png(tmp_path / "mask.png", np.zeros((16, 16), np.uint8))
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-1, 1, 9)] * 2))
    p = mi.Point3f(np.stack([x, y, 0 * x]).astype(np.float32))
    up, both = mi.Normal3f(0, 0, mi.Float(np.ones(81, np.float32))), dr.ones(mi.Bool, 81)

    def seen(background, **changes):
        views = tuple(replace(view, **changes) for view in dataset.views)
        data = replace(dataset, views=views, background=background)
        found = training_views(replace(recovered, dataset=data)).see(p, up, ~both, both)
        return np.array(found)

    assert seen("visible").mean() > 0.3
    assert np.array_equal(seen("hidden"), seen("visible"))
    assert np.array_equal(seen("visible", image=tmp_path / "clear.exr"), seen("visible"))
    assert not seen("hidden", image=tmp_path / "clear.exr").any()
    assert not seen("visible", mask=tmp_path / "mask.png").any()


def test_filling_keeps_what_is_known_and_takes_the_rest_from_it():
    rng = np.random.default_rng(0)
    values = rng.random((32, 32, 2)).astype(np.float32)
    known = np.zeros((32, 32), bool)
    known[4:9, 4:9] = True
    before = values[known]
    values[~known] = np.nan
    found = filled(values, known, (0.5, 0.5))
    np.testing.assert_array_equal(found[known], before)
    assert found.min() >= before.min() - 1e-6 and found.max() <= before.max() + 1e-6
    nothing = filled(np.ones((8, 8, 2), np.float32), np.zeros((8, 8), bool), (0.2, 0.7))
    assert (nothing == np.array([0.2, 0.7], np.float32)).all()


def test_names_of_files_are_safe_and_different():
    names = file_names(["a/b", "A_b", "..", "", "x" * 300, "père"])
    assert names[:4] == ["a_b", "A_b-2", "material", "material-2"]
    assert all(len(name) <= 60 and "/" not in name for name in names)


def test_one_format_needs_no_list(tmp_path):
    with pytest.raises(UserError) as error:
        exporting.export(tmp_path / "none", tmp_path / "out", "gltf")
    assert "no run" in str(error.value) and "no format" not in str(error.value)
    with pytest.raises(UserError, match="no format named 'obj'"):
        exporting.export(tmp_path / "none", tmp_path / "out", "obj")


@pytest.mark.parametrize(
    ("given", "unknown", "meant"),
    [
        (["gltf,usd"], None, None),
        ("gltf, textures,", None, None),
        (["gtlf,usd", "texture"], "'gtlf', 'texture'", "gltf textures"),
        (["xyz"], "'xyz'", None),
    ],
)
def test_formats_may_have_commas_and_the_nearest_is_told(given, unknown, meant, tmp_path, unbake):
    words = [given] if isinstance(given, str) else given
    outcome = unbake("export", tmp_path / "none", "--out", tmp_path / "out", "--format", *words)
    assert outcome.status == 2 and "no run" in outcome.err
    assert (f"no format named {unknown}" in outcome.err) == (unknown is not None)
    assert (f"Did you mean {meant}? There are gltf" in outcome.err) == (meant is not None)
    with pytest.raises(UserError, match="no run") as error:
        exporting.export(tmp_path / "none", tmp_path / "out", given)
    assert ("no format" in str(error.value)) == (unknown is not None)


def test_textures_have_no_more_texels_than_wanted(exported, tmp_path, monkeypatch):
    """Neither where they are dense, nor where they rise to hold what is recovered."""
    exported.use(monkeypatch)
    as_if_seen(monkeypatch)
    words = {"max_texture": 64, "tell": lambda line: None}
    for texels in (60.0, None):
        out = tmp_path / f"{texels}"
        told = exporting.export(exported.run, out, "gltf, mitsuba", texels=texels, **words)
        assert told["formats"] == ["gltf", "mitsuba"]
        assert {row["resolution"] for row in told["materials"]} == {64}
        limited = [row for row in told["materials"] if row["wanted_resolution"] > 64]
        assert sum("limited to 64 texels" in note for note in told["notes"]) == len(limited)
        assert limited or texels is None
        for image in trimesh.load(out / "scene.glb").geometry.values():
            if image.visual.material.baseColorTexture:
                assert image.visual.material.baseColorTexture.size == (64, 64)
        sizes = {read_exr(file).shape[:2] for file in (out / "mitsuba" / "textures").glob("*.exr")}
        assert max(size for size in sizes if size[1] == size[0]) <= (64, 64)


@pytest.mark.parametrize(
    "words", [{"formats": ["obj"]}, {"texels": -1.0}, {"formats": []}, {"max_texture": 1000}]
)
def test_wrong_words_are_told_before_anything_is_read(words, tmp_path):
    with pytest.raises(UserError) as error:
        exporting.export(tmp_path / "none", tmp_path / "out", **words)
    assert "no run" in str(error.value) and "--" in str(error.value)
    assert not (tmp_path / "out").exists()


def test_a_folder_with_something_in_it_is_left_alone(exported, tmp_path, unbake):
    (tmp_path / "mine").write_text("")
    outcome = unbake("export", exported.run, "--out", tmp_path)
    assert outcome.status == 2 and "the folder is not empty" in outcome.err
    assert [p.name for p in tmp_path.iterdir()] == ["mine"]


def test_the_command_tells_what_it_wrote(exported, tmp_path, unbake, monkeypatch):
    exported.use(monkeypatch)
    out = tmp_path / "out"
    outcome = unbake("export", exported.run, "--out", out, "--format", "gltf", "--texels", 2)
    assert outcome.status == 0 and outcome.err == ""
    lines = outcome.out.splitlines()
    assert "floor/paint: 64 x 64 texels, its own coordinates" in outcome.out
    assert lines[-1] == f"wrote {out}: scene.glb, export.json" and max(map(len, lines[:-1])) < 80
    assert sorted(p.name for p in out.iterdir()) == sorted(
        [
            *("environment.exr", "environment_upright.exr", "environment_unobserved.png"),
            *("export.json", "scene.glb", "unobserved"),
        ]
    )
    # The two cameras look down: what is below lights nothing that they show.
    mask = np.array(Image.open(out / "environment_unobserved.png")) > 127
    assert mask.shape == read_exr(out / "environment.exr").shape[:2]
    assert 0.05 < mask.mean() < 0.9
    part = re.search(r"note: nothing is known of (\d+) % of the environment: (\S+)", outcome.out)
    assert part is not None and part[2] == "environment_unobserved.png"
    # A file of glTF has no place for the masks of what no view saw.
    told = json.loads((out / "export.json").read_text())
    masks = {row["name"]: row["unobserved"] for row in told["materials"]}
    assert set(masks) == {"floor/paint", "stone", "cloth"} and set(masks.values()) < {
        *told["files"]
    }
    for row in told["materials"]:
        mask = np.array(mi.Bitmap(str(out / row["unobserved"])))
        assert mask.shape[:2] == (row["resolution"],) * 2
        assert (mask.max() == 255) == (row["unobserved_share"] > 0)


def test_textures_are_as_dense_as_the_fields_ask(exported, tmp_path, monkeypatch):
    exported.use(monkeypatch)
    as_if_seen(monkeypatch)
    monkeypatch.setattr("unbake.exports.unwrap.SMALLEST", 16)
    lines, found = [], {}
    for words in ({"texels": 0.5}, {}):
        told = exporting.export(exported.run, tmp_path / f"{words}", **words, tell=lines.append)
        found[len(words)] = {row["name"]: row for row in told["materials"]}
    chosen, coarse = found[0], found[1]
    assert all(row["near"]["albedo"] >= 0.95 for row in chosen.values())
    assert coarse["floor/paint"]["near"]["albedo"] < 0.9
    assert chosen["floor/paint"]["resolution"] > coarse["floor/paint"]["resolution"]
    # A file that another program reads says the same.
    assert gltf_near(exported, tmp_path / "{}")["ground"][0] >= 0.93
    (note,) = [line for line in lines if line.startswith("note: less than 95 %")]
    assert "floor/paint" in note and "without --texels" in note
    assert sum("is within 2/255 of the recovered fields" in line for line in lines) == 2


def test_a_failure_leaves_nothing(exported, tmp_path, monkeypatch):
    exported.use(monkeypatch)

    def fails(*words, **named):
        raise UserError("it fails")

    monkeypatch.setattr(exporting, "write_glb", fails)
    with pytest.raises(UserError, match="it fails"):
        exporting.export(exported.run, tmp_path / "out", ["gltf"], texels=2.0)
    assert list(tmp_path.iterdir()) == []
