"""Materials in scenes: each shape has its bitmap, stock integrators see them, steps train them."""

import gc

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import (
    assert_only_replayed,
    built_in_cameras,
    grey_photographs,
    one_thread,
    parameters_of,
    pixel_rays,
    randomised,
    seeded,
    tiny_fields,
)

from unbake.config import BitmapConfig
from unbake.errors import UserError
from unbake.fields.materials import make_materials
from unbake.fields.registry import representations
from unbake.fields.texture import material_numbers, material_textures
from unbake.scene import edit
from unbake.scene.parse import parse
from unbake.training.problem import make_problem
from unbake.training.state import initial_state
from unbake.training.step import TrainingStep
from unbake.transport.operator import attach_albedo, attach_material
from unbake.transport.path_sample import Requirements, rhs, trace
from unbake.transport.vertex import SceneView, find_vertex

REPRESENTATIONS = representations()


def assign_values(bitmaps, values):
    """Give bitmaps these values, (materials, size, size, channels)."""
    logits = np.log(values / (1 - values))
    bitmaps.assign({"texels": mi.Float(logits.astype(np.float32).ravel())})


# ---------------------------------------------------------------------------- bitmaps in a scene

SCENE = """<scene version="3.0.0">
  <bsdf type="twosided" id="Wall"><bsdf type="principled" id="wall"/></bsdf>
  <bsdf type="principled" id="red"/>
  <bsdf type="mask" id="Masked"><float name="opacity" value="1"/>
    <bsdf type="twosided"><bsdf type="diffuse" id="masked"/></bsdf></bsdf>
  <shape type="rectangle"><ref id="Wall"/></shape>
  <shape type="cube"><ref id="Wall"/>
    <transform name="to_world"><translate x="3"/></transform></shape>
  <shape type="cube"><ref id="red"/>
    <transform name="to_world"><translate x="6"/></transform></shape>
  <shape type="sphere"><bsdf type="dielectric"/>
    <transform name="to_world"><translate x="9"/></transform></shape>
  <shape type="cube"><ref id="red"/>
    <transform name="to_world"><translate x="12"/></transform></shape>
  <shape type="sphere"><bsdf type="principled" id="copper"/>
    <transform name="to_world"><translate x="15"/></transform></shape>
  <shape type="cube"><ref id="Masked"/>
    <transform name="to_world"><translate x="18"/></transform></shape>
  <shape type="shapegroup" id="group"><shape type="sphere"><ref id="red"/></shape></shape>
  <shape type="instance"><ref id="group"/>
    <transform name="to_world"><translate x="21"/></transform></shape>
  <emitter type="constant"/>
</scene>"""
#: Material of what stands at x = 0, 3, 6, …; None: not a material that is optimized.
STANDING = ["wall", "wall", "red", None, "red", "copper", "masked", "red"]


@pytest.fixture
def with_numbers(tmp_path):
    """A scene of several materials with bitmaps of one texel; its materials have the colours."""
    path = tmp_path / "scene.xml"
    path.write_text(SCENE)
    parsed = parse(path)
    edit.to_principled(parsed)
    names = edit.material_names(parsed)
    single = dict.fromkeys(("albedo", "roughness"), BitmapConfig(resolution=1))
    fields = make_materials("bitmap", single, names, seed=0)
    each = [material_textures(fields, number) for number in range(len(names))]
    edit.set_own_textures(parsed, each)
    scene = parsed.instantiate()
    fields.numbers = material_numbers(scene)
    colours = {name: 0.2 + 0.15 * i for i, name in enumerate(names)}
    assign_values(
        fields["albedo"],
        np.repeat(list(colours.values()), 3).reshape(-1, 1, 1, 3),
    )
    return SceneView.of(scene, fields, 4), colours


def rays_from_above():
    x = 3 * dr.arange(mi.Float, len(STANDING))
    ray = mi.Ray3f(mi.Point3f(x + 0.4, 0.3, 8), mi.Vector3f(0, 0, -1))
    dr.eval(ray)
    return ray


def test_every_shape_has_the_bitmap_of_its_material(with_numbers):
    scene_view, colours = with_numbers
    assert set(colours) == {"wall", "red", "copper", "masked"}
    expected = [colours.get(name) for name in STANDING]
    optimized = np.array([e is not None for e in expected])
    v = find_vertex(scene_view, rays_from_above(), mi.Bool(True), seeded(0, len(STANDING)))
    for attach in (attach_material, attach_albedo):
        found = np.array(attach(scene_view, v).albedo)[:, optimized]
        np.testing.assert_allclose(found, [[e for e in expected if e]] * 3, atol=1e-5)


def test_textures_find_their_bitmap_inside_virtual_calls(with_numbers):
    scene_view, colours = with_numbers
    scene_view.materials.stand_alone()
    si = scene_view.scene.ray_intersect(rays_from_above())
    found = np.array(si.bsdf().eval_diffuse_reflectance(si))
    for i, name in enumerate(STANDING):
        if name is not None:
            np.testing.assert_allclose(found[:, i], colours[name], atol=1e-5)


def test_meshes_are_merged_within_a_material_alone(with_numbers):
    scene_view, _ = with_numbers
    # A rectangle and another wall, which are not merged; red twice, which is; masked.
    assert sum(shape.is_mesh() for shape in scene_view.scene.shapes()) == 4


def test_materials_without_a_name_get_one_of_their_own(tmp_path):
    path = tmp_path / "scene.xml"
    bsdf = '<shape type="sphere"><bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>'
    # A name that could be one of those given.
    named = '<bsdf type="diffuse" id="material-1"/>'
    path.write_text(f'<scene version="3.0.0">{named}{3 * bsdf}</scene>')
    parsed = parse(path)
    edit.to_principled(parsed)
    names = edit.material_names(parsed)
    assert len(set(names)) == 4 and all(names) and "material-1" in names


def test_missing_texture_coordinates_are_told(tmp_path):
    mi.load_dict({"type": "cube"}).write_ply(str(tmp_path / "full.ply"))
    bare = mi.Mesh("bare", 3, 1)
    parameters = mi.traverse(bare)
    parameters["vertex_positions"] = [0, 0, 0, 1, 0, 0, 0, 1, 0]
    parameters["faces"] = [0, 1, 2]
    parameters.update()
    bare.write_ply(str(tmp_path / "bare.ply"))

    def problem(bsdf, representation):
        files = ("bare", "full", "bare")
        shapes = [
            f'<shape type="ply"><string name="filename" value="{f}.ply"/>{b}</shape>'
            for f, b in zip(files, (bsdf, '<bsdf type="diffuse"/>', bsdf), strict=True)
        ]
        path = tmp_path / "scene.xml"
        path.write_text(
            f'<scene version="3.0.0">{"".join(shapes)}<emitter type="constant"/></scene>'
        )
        return make_problem(path, "visible", tiny_fields(representation), 0.2)

    with pytest.raises(UserError) as caught:
        problem('<bsdf type="diffuse"/>', "bitmap")
    assert "without texture coordinates cannot have bitmaps: bare.ply" in caught.value.what
    assert "full" not in caught.value.what
    assert "--representation neural or grid, or unwrap the mesh" in str(caught.value)
    # Neither other representations nor other materials mind.
    assert problem('<bsdf type="diffuse"/>', "grid")
    assert problem('<bsdf type="conductor"/>', "bitmap")


# ------------------------------------------------------------------------ in a scene, in training


def cornell_problem(built_in, representation, radiance="neural"):
    config = tiny_fields(representation, radiance)
    return config, make_problem(built_in("cornell"), "visible", config, 0.2)


def test_bitmaps_render_as_mitsubas_own(built_in):
    """The same picture: bitmaps as arrays inside stock textures, and as fields."""
    _, problem = cornell_problem(built_in, "bitmap")
    randomised(problem.materials, scale=2)
    problem.materials.stand_alone()

    parsed = parse(built_in("cornell"))
    edit.to_principled(parsed)
    names = edit.material_names(parsed)
    fields = problem.materials
    stock = []
    for name in names:
        albedo, roughness = (fields[k].to_arrays()[name] for k in ("albedo", "roughness"))
        roughness = 0.02 + 0.98 * roughness
        stock.append(
            {
                slot: mi.load_dict({"type": "bitmap", "bitmap": mi.Bitmap(a), "raw": True})
                for slot, a in (("base_color", albedo), ("roughness", roughness))
            }
        )
    edit.set_own_textures(parsed, stock)
    scene = parsed.instantiate()
    assert len(names) >= 3

    ray = pixel_rays(built_in_cameras("cornell", 16), 4, seed=1)
    a, b = (s.ray_intersect(ray) for s in (problem.scene_view.scene, scene))
    ours, theirs = (np.array(si.bsdf().eval_diffuse_reflectance(si)) for si in (a, b))
    assert np.ptp(theirs) > 0.5
    np.testing.assert_allclose(ours, theirs, atol=1e-4)
    path = mi.load_dict({"type": "path", "max_depth": 4})
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f(built_in_cameras("cornell", 16)[0].to_world),
            "film": {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}},
        }
    )
    pictures = [
        np.array(mi.render(s, integrator=path, sensor=sensor, spp=32, seed=3))
        for s in (problem.scene_view.scene, scene)
    ]
    assert pictures[0].std() > 0.01
    np.testing.assert_allclose(pictures[0], pictures[1], rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize("representation", REPRESENTATIONS)
def test_fields_pass_gradients_inside_virtual_calls(built_in, representation):
    """Stock integrators ask textures inside BSDFs, and differentiate them there."""
    _, problem = cornell_problem(built_in, representation)
    ray = pixel_rays(built_in_cameras("cornell", 8), 4, seed=1)
    gradients = []
    for carried in (True, False):
        parameters = randomised(problem.materials)
        if not carried:
            problem.materials.stand_alone()
        v = find_vertex(problem.scene_view, ray, mi.Bool(True), seeded(0, dr.width(ray)))
        v = attach_material(problem.scene_view, v) if carried else v
        wo = mi.Vector3f(0.2, 0.3, 0.9)
        value = v.bsdf.eval(mi.BSDFContext(), v.si, dr.normalize(wo), v.valid)
        dr.backward(dr.sum(dr.sum(value)))
        gradients.append({k: np.array(dr.grad(p)).ravel() for k, p in parameters.items()})
    for name, gradient in gradients[0].items():
        scale = np.abs(gradient).max()
        assert scale > 0, name
        np.testing.assert_allclose(gradient, gradients[1][name], atol=2e-3 * scale, err_msg=name)


def rates(i):
    φ = 1e-2 * 0.9**i
    return {"albedo": φ, "roughness": φ, "radiance": 5e-3}


@pytest.mark.parametrize("radiance", ["neural", "grid"])
@pytest.mark.parametrize("representation", REPRESENTATIONS)
def test_a_frozen_step_trains_every_representation(built_in, representation, radiance):
    # Scenes of earlier tests, whose textures now stand alone, must not be around while one records.
    gc.collect()
    config, problem = cornell_problem(built_in, representation, radiance)
    pixels = grey_photographs(built_in_cameras("cornell", 8, views=2))
    step, state = TrainingStep(problem, pixels, config), initial_state(problem)
    before = parameters_of(state)
    assert_only_replayed(step, state, rates)
    for name, new in parameters_of(state).items():
        assert np.isfinite(new).all() and (new != before[name]).any(), f"{name} was not trained"
    # What was trained is what is seen.
    state.publish(problem)
    ray = pixel_rays(built_in_cameras("cornell", 8), 1, seed=1)
    v = find_vertex(problem.scene_view, ray, mi.Bool(True), seeded(0, dr.width(ray)))
    assert np.ptp(np.array(attach_albedo(problem.scene_view, v).albedo)) > 1e-3


# ------------------------------------------------------- integrators of Mitsuba, after training


def picture_of(problem, plugin="path"):
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "to_world": mi.ScalarTransform4f(built_in_cameras("cornell", 8)[0].to_world),
            "film": {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}},
        }
    )
    integrator = mi.load_dict({"type": plugin, "max_depth": 3})
    scene = problem.scene_view.scene
    return np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=8, seed=1))


def image_loss(problem, ray):
    """The sum of a picture of one bounce, made as a training loop of one's own makes it."""
    pieces = Requirements(1)
    sampler = seeded(0, dr.width(ray))
    sample = trace(problem.scene_view, None, ray, sampler, pieces)
    return dr.sum(dr.sum(rhs(sample, mi.Color3f(0.1))))


@pytest.mark.parametrize("plugin", ["path", "volpath"])
def test_mitsuba_renders_no_black_picture_after_a_loop_of_ones_own(built_in, plugin):
    """Textures evaluate the fields where nothing was put on the surface for them."""
    _, problem = cornell_problem(built_in, "neural")
    ray = pixel_rays(built_in_cameras("cornell", 8), 4, seed=1)
    optimizer = mi.ad.Adam(1e-2, problem.parameters())
    for _ in range(2):
        problem.assign(dict(optimizer.items()))
        dr.backward(image_loss(problem, ray))
        optimizer.step()
    problem.assign(dict(optimizer.items()))
    found = picture_of(problem, plugin)
    problem.materials.stand_alone()
    assert found.mean() > 0.01
    np.testing.assert_array_equal(found, picture_of(problem, plugin))


@pytest.mark.parametrize("representation", ["neural", "bitmap"])
def test_a_loop_has_the_same_gradients_where_materials_stand_alone(built_in, representation):
    _, problem = cornell_problem(built_in, representation)
    ray = pixel_rays(built_in_cameras("cornell", 8), 4, seed=1)
    gradients = []
    for alone in (False, True):
        parameters = randomised(problem.materials)
        problem.materials.carried = not alone
        with one_thread():
            dr.backward(image_loss(problem, ray))
            gradients.append({k: np.array(dr.grad(p)) for k, p in parameters.items()})
    assert max(np.abs(g).max() for g in gradients[0].values()) > 0
    for name, gradient in gradients[0].items():
        np.testing.assert_array_equal(gradient, gradients[1][name], err_msg=name)


def test_mitsuba_renders_what_was_assigned_last(built_in):
    _, problem = cornell_problem(built_in, "neural")
    problem.materials.stand_alone()
    before = picture_of(problem)
    parameters = {k: 3 * p for k, p in randomised(problem.materials, 1).items()}
    problem.assign({**problem.parameters(), **parameters})
    found = picture_of(problem)
    problem.materials.stand_alone()
    assert np.abs(found - before).max() > 0.01
    np.testing.assert_array_equal(found, picture_of(problem))
