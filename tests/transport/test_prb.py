"""What Mitsuba's path replay gives when it is asked for samples, and what it leaves behind."""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import (
    TINY_FIT,
    ConstantMaterials,
    assert_same_expectation,
    built_in_cameras,
    pixel_rays,
    seeded,
    stock_path,
)

from unbake.acquisition.capture import capture
from unbake.acquisition.settings import CaptureSettings
from unbake.dataset.camera import Camera
from unbake.fields.materials import is_carrying
from unbake.fields.texture import material_textures
from unbake.scene import edit
from unbake.scene.parse import parse
from unbake.training.problem import make_problem
from unbake.transport.loss import pixel_means, squared_error
from unbake.transport.path_tracer import path_traced
from unbake.transport.prb import (
    light_through_holes,
    materials_along_paths,
    path_radiance,
    path_replay,
)
from unbake.transport.vertex import SceneView, find_vertex

DEPTH = 4


@pytest.fixture(scope="module")
def rays():
    return pixel_rays(built_in_cameras("cornell", 16), 16, seed=1)


@pytest.fixture(scope="module")
def neural(built_in):
    """The Cornell box with neural materials that are not smooth."""
    problem = make_problem(built_in("cornell"), "visible", TINY_FIT, 0.2)
    rng = np.random.default_rng(1)
    phi = {k: type(v)(v) for k, v in problem.materials.parameters().items()}
    for key in (k for k in phi if k.endswith("grid")):
        phi[key] = mi.Float(rng.uniform(-1, 1, dr.width(phi[key])).astype(np.float32))
    return problem, phi


def backpropagated(neural, ray, *, inside_textures=False):
    """Radiance, and the gradients of a weighted sum of it."""
    problem, phi = neural
    phi = {k: type(v)(v) for k, v in phi.items()}
    dr.enable_grad(phi)
    problem.materials.assign(phi)
    integrator = path_replay(DEPTH, DEPTH, False)
    with materials_along_paths(problem.materials):
        problem.materials.carried &= not inside_textures
        sampler = seeded(2, dr.width(ray))
        image = path_radiance(integrator, problem.scene_view.scene, sampler, ray, phi)
        dr.backward(dr.mean(image.x + 2 * image.y + 3 * image.z))
    return np.array(dr.detach(image)), {k: np.array(dr.grad(v)).ravel() for k, v in phi.items()}


@pytest.mark.parametrize("hidden", [False, True])
def test_radiance_is_that_of_mitsubas_path_tracer(built_in, hidden):
    scene = mi.load_file(str(built_in("cornell")))
    ray = pixel_rays(built_in_cameras("cornell", 16), 64, seed=1)
    integrator = path_replay(6, 5, hidden)
    ours = path_radiance(integrator, scene, seeded(2, dr.width(ray)), ray, {})
    theirs = stock_path(scene, ray, 3, max_depth=6, hide_emitters=hidden)
    assert_same_expectation(ours, theirs, 64)


def test_prb_asks_the_fields_once_a_vertex_with_the_result_of_textures(neural, rays):
    image, gradients = backpropagated(neural, rays)
    expected, others = backpropagated(neural, rays, inside_textures=True)
    np.testing.assert_allclose(image, expected, rtol=1e-4, atol=1e-5)
    for key, gradient in gradients.items():
        assert np.abs(gradient).max() > 0, key
        scale = np.abs(others[key]).max()
        np.testing.assert_allclose(gradient / scale, others[key] / scale, atol=1e-4, err_msg=key)


def test_paths_leave_nothing_behind(neural):
    problem, _ = neural
    interaction = mi.PreliminaryIntersection3f.compute_surface_interaction
    problem.materials.carried = True
    with pytest.raises(ZeroDivisionError), materials_along_paths(problem.materials):  # noqa: PT012
        assert is_carrying()
        raise ZeroDivisionError
    assert problem.materials.carried and not is_carrying()
    assert mi.PreliminaryIntersection3f.compute_surface_interaction is interaction
    with materials_along_paths(None):
        assert mi.PreliminaryIntersection3f.compute_surface_interaction is interaction


def test_the_sampler_goes_on(built_in):
    """A second pass has other random numbers, as a second estimate needs."""
    scene = mi.load_file(str(built_in("cornell")))
    ray = pixel_rays(built_in_cameras("cornell", 16), 1, seed=1)
    # Each ray 32 times: only what happens along the path makes the samples differ.
    ray = dr.gather(mi.Ray3f, ray, dr.arange(mi.UInt32, 32 * dr.width(ray)) // 32)
    integrator, sampler = path_replay(4, 4, False), seeded(2, dr.width(ray))
    passes = [path_radiance(integrator, scene, sampler, ray, {}).y for _ in range(2)]
    a, b = (x - x.mean(1)[:, None] for x in (np.array(x).reshape(-1, 32) for x in passes))
    correlation = (a * b).mean() / np.sqrt((a**2).mean() * (b**2).mean())
    print(f"{correlation:.4f}")
    assert abs(correlation) < 0.05


LIT_OBJECT = """<scene version="3.0.0">
  <bsdf type="principled" id="grey"><rgb name="base_color" value="0.5"/></bsdf>
  <shape type="sphere"><ref id="grey"/></shape>
  <shape type="rectangle">
    <transform name="to_world">
      <scale value="0.5"/>
      <lookat origin="0, -1.5, 1.5" target="0, 0, 0" up="0, 0, 1"/>
    </transform>
    <emitter type="area"><rgb name="radiance" value="4"/></emitter>
  </shape>
  <emitter type="constant"><rgb name="radiance" value="0.7"/></emitter>
</scene>"""


def test_hidden_lights_are_those_of_the_photographs(tmp_path):
    (tmp_path / "lit.xml").write_text(LIT_OBJECT)
    settings = CaptureSettings(views=2, held_out=0, resolution=16, spp=256, max_depth=5, rr_depth=5)
    dataset = capture(str(tmp_path / "lit.xml"), tmp_path / "data", settings, tell=lambda _: None)
    assert dataset.background == "hidden"
    scene = mi.load_file(str(dataset.scene))
    cameras = [view.camera for view in dataset.views]
    ray = pixel_rays(cameras, 256, seed=1)
    integrator = path_replay(5, 5, True)
    radiance = path_radiance(integrator, scene, seeded(2, dr.width(ray)), ray, {})
    image = np.array(pixel_means(radiance, 256)).T
    photographs = np.concatenate(
        [np.array(mi.Bitmap(str(v.image)))[..., :3].reshape(-1, 3) for v in dataset.views]
    )
    assert (photographs == 0).any(), "no background"
    np.testing.assert_allclose(image.mean(), photographs.mean(), rtol=5e-3)
    # Neither environment nor light in view: 0.7 and 4 would show.
    np.testing.assert_allclose(image, photographs, atol=0.1)


# ------------------------------------------------------------------------------------ cut-outs


def leaves(tmp_path, *, instanced):
    """A half opaque leaf over a floor, under a lamp and a sky; and a camera that sees both."""
    leaf = """<shape type="rectangle"><bsdf type="mask"><float name="opacity" value="0.5"/>
      <bsdf type="twosided"><bsdf type="principled"/></bsdf></bsdf>{}</shape>"""
    place = """<transform name="to_world"><rotate x="1" angle="25"/><scale value="0.7"/>
      <translate z="0.6"/></transform>"""
    group = f'<shape type="shapegroup" id="leaf">{leaf.format("")}</shape>'
    group += f'<shape type="instance"><ref id="leaf"/>{place}</shape>'
    floor = '<shape type="rectangle"><bsdf type="principled"/></shape>'
    content = (group if instanced else leaf.format(place)) + floor
    scene = LIT_OBJECT.replace('<shape type="sphere"><ref id="grey"/></shape>', content)
    path = tmp_path / "leaves.xml"
    path.write_text(scene)
    return path, Camera.look_at((1.5, -2, 2), (0, 0, 0.2), (0, 0, 1), 40.0, 12, 12)


@pytest.mark.parametrize("hidden", [False, True], ids=["seen", "hidden"])
@pytest.mark.parametrize("instanced", [False, True], ids=["shape", "instance"])
def test_cut_outs_are_those_of_mitsubas_volumetric_path_tracer(tmp_path, instanced, hidden):
    path, camera = leaves(tmp_path, instanced=instanced)
    scene = mi.load_file(str(path))
    ray = pixel_rays([camera], 1024, seed=1)
    ours = path_radiance(path_replay(24, 5, hidden), scene, seeded(2, dr.width(ray)), ray, {})
    if hidden:
        ours -= light_through_holes(scene, ray, 24)
    # `volpath` does not count the surfaces that a path passes.
    theirs = stock_path(scene, ray, 3, max_depth=12, integrator="volpath", hide_emitters=hidden)
    assert_same_expectation(ours, theirs, 1024)


def leaf(*, lamp=False, opacity=0.5):
    """A leaf before the sky, or before a lamp, and rays that it fills."""
    material = {"type": "principled", "roughness": 0.5}
    mask = {"type": "mask", "opacity": opacity, "bsdf": {"type": "twosided", "bsdf": material}}
    content = {
        "type": "scene",
        "sky": {"type": "constant", "radiance": 1.0},
        "leaf": {"type": "rectangle", "bsdf": mask},
    }
    if lamp:
        content["lamp"] = {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate([0, 0, -1]),
            "bsdf": {"type": "diffuse", "reflectance": 0.0},
            "emitter": {"type": "area", "radiance": 5.0},
        }
    camera = Camera.look_at((0.3, 0, 4), (0, 0, 0), (0, 1, 0), 40.0, 8, 8)
    return mi.load_dict(content), pixel_rays([camera], 1024, seed=1)


@pytest.mark.parametrize("opacity", [0.0, 0.5])
def test_a_chain_that_ends_nowhere_leaves_numbers(opacity):
    scene, ray = leaf(opacity=opacity)
    sampler = seeded(2, dr.width(ray))
    vertex = find_vertex(SceneView.of(scene, None, 8), ray, mi.Bool(True), sampler)
    valid, found = np.array(vertex.valid), np.array(vertex.opacity)
    assert valid.any() == (opacity > 0) and not valid.all()
    assert (found[~valid] == 1).all() and (found[valid] == opacity).all()


@pytest.mark.parametrize("lamp", [False, True], ids=["sky", "lamp"])
def test_no_method_sees_hidden_lights_through_cut_outs(lamp):
    scene, ray = leaf(lamp=lamp)
    theirs = stock_path(scene, ray, 3, max_depth=12, integrator="volpath", hide_emitters=True)
    scene_view = SceneView.of(scene, None, 8)
    traced = path_traced(scene_view, ray, 2, max_depth=12, rr_depth=5, hide_emitters=True)
    assert_same_expectation(traced, theirs, 1024)
    replayed = path_radiance(path_replay(24, 5, True), scene, seeded(2, dr.width(ray)), ray, {})
    through = light_through_holes(scene, ray, 24)
    assert np.array(through).max() > 0.4, "there was nothing to see"
    assert_same_expectation(replayed - through, theirs, 1024)


@pytest.mark.parametrize("material", ["thindielectric", "null"])
def test_no_method_sees_hidden_lights_through_thin_panes(material):
    """What `path` says of them, by which photographs of such scenes are rendered."""
    pane = {"type": "rectangle", "bsdf": {"type": material}}
    ball = {"type": "sphere", "center": [0, 0, -3], "bsdf": {"type": "diffuse"}}
    scene = mi.load_dict({"type": "scene", "sky": {"type": "constant"}, "pane": pane, "b": ball})
    scene_view = SceneView.of(scene, None, 8)
    assert scene_view.has_holes
    ray = pixel_rays([Camera.look_at((0.3, 0, 4), (0, 0, 0), (0, 1, 0), 40.0, 8, 8)], 1024, seed=1)
    theirs = stock_path(scene, ray, 3, max_depth=12, hide_emitters=True)
    traced = path_traced(scene_view, ray, 2, max_depth=12, rr_depth=5, hide_emitters=True)
    assert_same_expectation(traced, theirs, 1024)
    replayed = path_radiance(path_replay(12, 5, True), scene, seeded(2, dr.width(ray)), ray, {})
    assert_same_expectation(replayed - light_through_holes(scene, ray, 12), theirs, 1024)


def test_light_through_holes_passes_gradients_to_the_sky():
    scene, ray = leaf()
    parameters = mi.traverse(scene)
    sky = parameters["sky.radiance.value"]
    dr.enable_grad(sky)
    parameters["sky.radiance.value"] = sky
    parameters.update()
    light = light_through_holes(scene, ray, 24)
    dr.backward(dr.sum(light, axis=None))
    # The sky's radiance is 1, so that light and gradient are the same numbers.
    assert np.array(light).sum() > 0
    gradient = np.array(dr.grad(parameters["sky.radiance.value"])).sum()
    np.testing.assert_allclose(gradient, np.array(light).sum(), rtol=1e-4)


@pytest.mark.parametrize(
    "instanced",
    [pytest.param(False, marks=pytest.mark.slow), True],
    ids=["shape", "instance"],
)
def test_gradients_through_cut_outs_are_finite_differences(tmp_path, instanced):
    """Neither the material nor the cut-out samples by albedo: the same paths show its effect."""
    path, camera = leaves(tmp_path, instanced=instanced)
    materials = ConstantMaterials(0.5, 0.6)
    parsed = parse(path)
    edit.set_textures(parsed, material_textures(materials))
    scene = parsed.instantiate()
    ray, integrator = pixel_rays([camera], 64, seed=1), path_replay(5, 99, False)

    def mean(albedo):
        materials.albedo = mi.Color3f(albedo)
        dr.enable_grad(materials.albedo)
        with materials_along_paths(materials):
            sampler, phi = seeded(2, dr.width(ray)), {"albedo": materials.albedo}
            loss = dr.mean(path_radiance(integrator, scene, sampler, ray, phi).y)
            dr.backward(loss)
        return float(loss[0]), float(dr.grad(materials.albedo).y[0])

    _, gradient = mean(0.5)
    above, below = (mean(0.5 + h)[0] for h in (0.02, -0.02))
    difference = (above - below) / 0.04
    print(f"{gradient:.5f}, {difference:.5f}")
    assert difference > 0.1
    assert gradient == pytest.approx(difference, rel=2e-3)


# ----------------------------------------------------------------- one pass and two


@pytest.mark.slow
def test_one_pass_and_two_have_one_expectation(built_in):
    materials = ConstantMaterials(0.6, 0.4)
    parsed = parse(built_in("cornell"))
    edit.to_principled(parsed)
    edit.set_textures(parsed, material_textures(materials))
    scene = parsed.instantiate()
    spp, integrator = 4, path_replay(3, 3, False)
    cameras = built_in_cameras("cornell", 16)
    target, weight = mi.Color3f(0.1), mi.Color3f(1)
    target += dr.zeros(mi.Float, 16 * 16)

    def gradient(seed, one_pass):
        materials.albedo = mi.Color3f(0.6)
        dr.enable_grad(materials.albedo)
        sampler, phi = seeded(seed, 16 * 16 * spp), {"albedo": materials.albedo}
        # Rays, too, are others in each pass: where in a pixel they start is part of the noise.
        ray, other = (pixel_rays(cameras, spp, seed + offset) for offset in (1000, 2000))
        with materials_along_paths(materials):
            primal = None
            if not one_pass:
                with dr.suspend_grad():
                    again = path_radiance(integrator, scene, sampler, other, phi)
                    primal = pixel_means(again, spp)
            image = path_radiance(integrator, scene, sampler, ray, phi)
            dr.backward(squared_error(image, target, spp, weight, primal))
        return float(dr.grad(materials.albedo).x[0])

    estimates = [np.array([gradient(s, one) for s in range(60)]) for one in (True, False)]
    a, b = (x.mean() for x in estimates)
    error = np.hypot(*(x.std(ddof=1) / np.sqrt(len(x)) for x in estimates))
    print(f"{a:.5f} and {b:.5f}, standard error {error:.5f}")
    assert abs(a - b) < 3.5 * error
    assert error < 0.1 * abs(a), "the test sees nothing"


def test_settings_reach_the_integrator():
    config = dataclasses.replace(TINY_FIT, method="prb")
    integrator = path_replay(config.path.chosen_depth, config.path.rr_depth, True)
    assert (integrator.max_depth, integrator.rr_depth) == (15, 5)
    assert integrator.hide_emitters
