"""What lies behind lamps that cameras do not see is where it is, whatever shape both have."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from support import TINY_FIT, assert_only_replayed, grey_photographs, pixel_rays, seeded

from unbake.acquisition.capture import photographs
from unbake.acquisition.settings import CaptureSettings
from unbake.dataset.camera import Camera
from unbake.dataset.pixels import CameraRays
from unbake.training.problem import make_problem
from unbake.training.state import initial_state
from unbake.training.step import TrainingStep
from unbake.transport.path_tracer import path_traced
from unbake.transport.prb import path_radiance, path_replay
from unbake.transport.vertex import SceneView, find_vertex, rays_behind_area_emitters

CAMERA = Camera.look_at((0, 0, 6), (0, 0, 0), (0, 1, 0), 25.0, 8, 8)
SPP = 256
PLACE = mi.ScalarTransform4f().translate([0, 0, 3])
LAMPS = {
    "rectangle": {"type": "rectangle", "to_world": PLACE.rotate([0, 1, 0], 180).scale(0.4)},
    "sphere": {"type": "sphere", "center": [0, 0, 3], "radius": 0.4},
    "cube": {"type": "cube", "to_world": PLACE.scale(0.3)},
    "none": None,
}
MATERIAL = {"type": "principled", "base_color": {"type": "rgb", "value": [0.6, 0.5, 0.4]}}

SCENE = """<scene version="3.0.0">
  <shape type="sphere"><bsdf type="principled"/></shape>
  <shape type="sphere"><point name="center" x="0" y="0" z="3"/><float name="radius" value="0.4"/>
    <emitter type="area"><rgb name="radiance" value="3"/></emitter></shape>
  <emitter type="constant"><rgb name="radiance" value="0.1"/></emitter>
</scene>"""


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    """A sphere as a mesh: its hits have barycentric coordinates, which no ray's start changes."""
    rows, columns = 200, 400
    θ, φ = np.meshgrid(
        np.linspace(0, np.pi, rows), np.linspace(0, 2 * np.pi, columns), indexing="ij"
    )
    points = np.stack([np.sin(θ) * np.cos(φ), np.sin(θ) * np.sin(φ), np.cos(θ)], -1).reshape(-1, 3)
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    faces = np.concatenate(
        [
            np.stack([corner, corner + columns, corner + columns + 1], -1),
            np.stack([corner, corner + columns + 1, corner + 1], -1),
        ]
    )
    mesh = mi.Mesh("ball", len(points), len(faces), has_vertex_normals=True)
    content = mi.traverse(mesh)
    content["vertex_positions"] = content["vertex_normals"] = points.ravel()
    content["faces"] = faces.ravel()
    content.update()
    file = tmp_path_factory.mktemp("mesh") / "ball.ply"
    mesh.write_ply(str(file))
    return {"type": "ply", "filename": str(file)}


def scene_of(thing, lamp):
    content = {"type": "scene", "thing": thing | {"bsdf": MATERIAL}}
    content["sky"] = {"type": "constant", "radiance": 0.1}
    if lamp is not None:
        content["lamp"] = lamp | {"emitter": {"type": "area", "radiance": 3.0}}
    return mi.load_dict(content)


@pytest.mark.parametrize("name", LAMPS)
def test_a_sphere_behind_a_hidden_lamp_is_lit_like_a_mesh_of_it(name, ball):
    lamp, sphere = LAMPS[name], {"type": "sphere"}
    ray = pixel_rays([CAMERA], SPP, seed=1)
    found = {}
    for kind, thing in (("mesh", ball), ("sphere", sphere)):
        scene = scene_of(thing, lamp)
        view = SceneView.of(scene, None, 8)
        light = path_traced(view, ray, 2, max_depth=4, rr_depth=5, hide_emitters=True)
        found[f"ours, {kind}"] = np.array(light).mean(1)
        replay = path_replay(4, 5, True)
        seen = rays_behind_area_emitters(scene, ray)
        light = path_radiance(replay, scene, seeded(3, SPP * 64), seen, {})
        found[f"prb, {kind}"] = np.array(light).mean(1)
        how = CaptureSettings(max_depth=4, rr_depth=5, seed=4)
        sampler = mi.load_dict({"type": "independent", "sample_count": SPP})
        rgb, alpha, _ = photographs(
            scene, CameraRays.of([CAMERA]), how, sampler, False, lambda line: None
        )
        found[f"photographs, {kind}"] = rgb.mean(0)
        assert alpha.max() == 1 and alpha.reshape(8, 8)[4, 4] == 1
    truth = found["ours, mesh"]
    for kind, value in found.items():
        np.testing.assert_allclose(value, truth, rtol=0.03, err_msg=kind)
    if lamp is not None:
        bare = path_traced(
            SceneView.of(scene_of(sphere, None), None, 8), ray, 2,
            max_depth=4, rr_depth=5, hide_emitters=True,
        )  # fmt: skip
        assert truth[0] > 1.5 * np.array(bare).mean()


def test_vertices_behind_closed_lamps_lie_on_their_surface():
    view = SceneView.of(scene_of({"type": "sphere"}, LAMPS["sphere"]), None, 8)
    ray = pixel_rays([CAMERA], 16, seed=1)
    vertex = find_vertex(view, ray, mi.Bool(True), seeded(0, 16 * 64), hide_emitters=True)
    radius = np.linalg.norm(np.array(vertex.si.p), axis=0)[np.array(vertex.valid)]
    assert len(radius) > 100
    np.testing.assert_allclose(radius, 1, atol=1e-4)


@pytest.mark.parametrize("method", ["ours", "prb"])
def test_steps_with_hidden_lamps_are_replayed(method, tmp_path):
    """Rays that start behind lamps are a part of the recording."""
    file = tmp_path / "scene.xml"
    file.write_text(SCENE)
    config = replace(TINY_FIT, method=method)
    problem = make_problem(file, "hidden", config, 0.2)
    assert problem.hide_emitters and problem.scene_view.has_area_emitters
    step = TrainingStep(problem, grey_photographs([CAMERA, CAMERA]), config)
    rates = dict.fromkeys(("albedo", "roughness", "radiance"), 1e-3)
    assert_only_replayed(step, initial_state(problem), lambda number: rates)
