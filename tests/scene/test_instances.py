"""Instances: the shapes of their groups are found, sampled where they stand, and optimized."""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scene_texts import BALL, PRINCIPLED, ROOM
from support import TINY_FIT, assert_only_replayed, grey_photographs

from unbake.acquisition.capture import capture
from unbake.acquisition.settings import CaptureSettings
from unbake.dataset.camera import Camera
from unbake.errors import UserError
from unbake.fields.shapes import met_shapes, placed_shapes
from unbake.scene.free_space import sample_surface
from unbake.training.problem import make_problem
from unbake.training.state import initial_state
from unbake.training.step import TrainingStep
from unbake.transport.optimized import optimized_shapes

GROUP = '<shape type="shapegroup" id="{}">{}</shape>'
INSTANCE = '<shape type="instance"><ref id="{}"/><transform name="to_world">{}</transform></shape>'
WALL = '<shape type="rectangle">{}</shape>'
MASK = '<bsdf type="mask"><float name="opacity" value="0.5"/>{}</bsdf>'
NEAR, FAR = '<translate x="-1.2"/>', '<scale value="0.5"/><translate x="1" y="0.5"/>'
CAMERA = Camera.look_at((0, 0, 4), (0, 0, 0), (0, 1, 0), 40.0, 12, 12)


def grouped(*shapes):
    return GROUP.format("leaf", "".join(shapes)) + "".join(
        INSTANCE.format("leaf", to_world) for to_world in (NEAR, FAR)
    )


def test_instances_stand_for_the_shapes_of_their_group(parse):
    unused = GROUP.format("unused", WALL.format(PRINCIPLED))
    scene = parse(grouped(WALL.format(PRINCIPLED), BALL.format("")) + unused).instantiate()
    assert [s.class_name() for s in scene.shapes()] == ["Instance"] * 2
    placed = []
    for one in placed_shapes(scene):
        assert one.to_world is not None
        placed.append((one.shape.class_name(), one.to_world[:3, 3].tolist()))
    assert sorted(placed) == [
        ("Rectangle", [-1.2000000476837158, 0, 0]),
        ("Rectangle", [1, 0.5, 0]),
        ("Sphere", [-1.2000000476837158, 0, 0]),
        ("Sphere", [1, 0.5, 0]),
    ]
    assert sorted(s.class_name() for s in met_shapes(scene)) == ["Rectangle", "Sphere"]
    assert len(optimized_shapes(scene)) == 1


@pytest.mark.parametrize(
    ("inner", "reason"),
    [
        (INSTANCE.format("leaf", NEAR), "Nested instancing is not permitted"),
        (WALL.format('<emitter type="area"/>'), "Instancing of emitters is not supported"),
    ],
    ids=["instances", "emitters"],
)
def test_what_mitsuba_refuses_inside_a_group_is_told_in_one_line(inner, reason, parse):
    leaf = GROUP.format("leaf", WALL.format(PRINCIPLED))
    content = leaf + GROUP.format("outer", inner) + INSTANCE.format("outer", FAR)
    with pytest.raises(UserError, match=reason) as caught:
        parse(content).instantiate()
    assert "\n" not in str(caught.value)


def test_surfaces_are_sampled_where_instances_stand(parse):
    """By area: the one instance has half the size, and the ball is metal that is known."""
    metal = BALL.format('<bsdf type="roughconductor"/>')
    turned = '<rotate x="1" angle="90"/><scale value="0.5"/><translate x="1" y="0.5"/>'
    content = GROUP.format("leaf", WALL.format(PRINCIPLED) + metal)
    content += INSTANCE.format("leaf", NEAR) + INSTANCE.format("leaf", turned)
    content += '<shape type="rectangle"><transform name="to_world"><translate z="-3"/></transform>'
    content += PRINCIPLED + "</shape>"
    points = sample_surface(parse(content).instantiate(), 9000, 1)
    p, n = points.position, points.normal
    behind = p[:, 2] < -2
    near = ~behind & (p[:, 0] < 0)
    far = ~behind & (p[:, 0] > 0)
    assert np.abs(p[near, 2]).max() < 1e-5 and np.abs(p[far, 1] - 0.5).max() < 1e-5
    np.testing.assert_allclose(p[near].min(0), [-2.2, -1, 0], atol=0.01)
    np.testing.assert_allclose(p[far].max(0), [1.5, 0.5, 0.5], atol=0.01)
    np.testing.assert_allclose(np.abs(n[near, 2]), 1, atol=1e-6)
    np.testing.assert_allclose(np.abs(n[far, 1]), 1, atol=1e-6)
    share = np.array([behind.mean(), near.mean(), far.mean()])
    np.testing.assert_allclose(share, np.array([4, 4, 1]) / 9, atol=0.02)


def test_a_scene_of_instances_can_be_captured(tmp_path):
    """Coverage asked each shape for its area, which an instance does not know."""
    (tmp_path / "scene.xml").write_text(ROOM.format(grouped(BALL.format(PRINCIPLED))))
    settings = CaptureSettings(views=3, held_out=0, resolution=8, spp=4, max_depth=3)
    dataset = capture(str(tmp_path / "scene.xml"), tmp_path / "data", settings, tell=lambda _: None)
    assert dataset.coverage is not None and dataset.coverage > 0.5
    masks = [np.array(mi.Bitmap(str(v.truth["albedo"])))[..., 3] for v in dataset.views]
    assert np.max(masks) == 1


# ----------------------------------------------------------------------------------- optimized


def pieces_of(bsdf):
    """A ball and a wall behind it, with and without an instance."""
    back = '<transform name="to_world"><translate z="-1"/></transform>'
    shapes = [BALL.format(bsdf), f'<shape type="rectangle">{back}{bsdf}</shape>']
    whole = GROUP.format("leaf", "".join(shapes)) + INSTANCE.format("leaf", "")
    return {"plain": "".join(shapes), "instance": whole}


@pytest.mark.parametrize(
    ("method", "wrapper"), [("ours", "{}"), ("ours", MASK), ("prb", MASK), ("ad-pt", MASK)]
)
def test_materials_learn_the_same_inside_an_instance(method, wrapper, tmp_path):
    """Fields are functions of positions in the world, wherever a shape has its own."""
    found = {}
    for name, content in pieces_of(wrapper.format(PRINCIPLED)).items():
        path = tmp_path / f"{name}.xml"
        path.write_text(ROOM.format(content))
        config = dataclasses.replace(
            TINY_FIT, method=method, path=dataclasses.replace(TINY_FIT.path, max_depth=3)
        )
        problem = make_problem(path, "visible", config, 0.3)
        assert problem.scene_view.has_chains == (wrapper == MASK)
        assert len(problem.scene_view.optimized) == 2
        step = TrainingStep(problem, grey_photographs([CAMERA]), config)
        state = initial_state(problem)
        rates = dict.fromkeys((*config.quantities, "radiance"), 0.01)
        start = {k: np.array(v).ravel() for k, v in state.phi.items()}
        terms = [step(state, i, rates) for i in range(2)]
        assert float(terms[-1]["skipped"][0]) == 0
        dr.eval(terms)
        found[name] = (
            {k: [float(t[k][0]) for t in terms] for k in terms[0]},
            {k: np.array(v).ravel() - start[k] for k, v in state.phi.items()},
        )
        del step
    (losses, moved), (expected, others) = found["instance"], found["plain"]
    for key, values in losses.items():
        np.testing.assert_allclose(values, expected[key], rtol=2e-3, atol=1e-5, err_msg=key)
    for key, change in moved.items():
        assert np.abs(change).max() > 1e-3, key
        # Adam's first steps are signs: where a gradient is almost zero, rounding decides.
        assert (np.abs(change - others[key]) > 1e-3).mean() < 0.02, key


def test_steps_with_instances_are_replayed(tmp_path):
    content = pieces_of(MASK.format(PRINCIPLED))["instance"]
    (tmp_path / "scene.xml").write_text(ROOM.format(content))
    problem = make_problem(tmp_path / "scene.xml", "visible", TINY_FIT, 0.3)
    step = TrainingStep(problem, grey_photographs([CAMERA]), TINY_FIT)
    rates = dict.fromkeys((*TINY_FIT.quantities, "radiance"), 0.01)
    assert_only_replayed(step, initial_state(problem), lambda i: rates)
