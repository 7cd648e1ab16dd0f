"""What a term attaches decides which look-ups of L_θ, and which bounces, take gradients."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import built_in_cameras, enable_gradients, pixel_rays, seeded

from unbake.dataset.camera import Camera
from unbake.transport.loss import RelativeL2
from unbake.transport.methods import EXTRA, LHS, PHOTOMETRIC, PRIOR, PRIOR_PAIR, Attached
from unbake.transport.objective import objective, requirements
from unbake.transport.operator import attach_albedo
from unbake.transport.path_sample import SampleSubset, trace
from unbake.transport.vertex import SceneView, find_vertex

SPP, FEW = 4, 2
#: So large that what errors are relative to is next to constant, which it is for gradients.
LOSS = RelativeL2(1e6)
BOTH = Attached(lhs=True, rhs=True)


class LearnedConstant:
    """A radiance field that is one number everywhere, its parameter."""

    def __init__(self, value: float) -> None:
        self.value = mi.Float(value)
        dr.make_opaque(self.value)
        dr.enable_grad(self.value)

    def evaluate(self, p, w, n, albedo, valid, engine=None) -> mi.Color3f:
        return dr.select(valid, mi.Color3f(self.value), 0)


@pytest.fixture(scope="module")
def rays():
    return pixel_rays(built_in_cameras("cornell", 6), SPP, seed=1)


def photographs(rays):
    return mi.Color3f(0.1 + 0.3 * dr.arange(mi.Float, dr.width(rays) // SPP) / 36)


def traced(problem, radiance, rays, row, *, bounces=1, subset=False):
    chosen = None
    if subset:
        lane = dr.arange(mi.UInt32, dr.width(rays) // SPP * FEW)
        lanes = lane // FEW * SPP + lane % FEW
        chosen = SampleSubset(lanes, seeded(79, dr.width(lanes)))
    wanted = requirements(row, bounces)
    sampler = seeded(2, dr.width(rays))
    return trace(problem.scene_view, radiance, rays, sampler, wanted, subset=chosen)


def value_of(problem, radiance, rays, row, *, bounces=1, subset=False):
    """The sum of a row's terms."""
    sample = traced(problem, radiance, rays, row, bounces=bounces, subset=subset)
    return sum(objective(row, sample, photographs(rays), LOSS, None, bounces).values())


def gradient(problem, rays, row, which="θ", **settings):
    """By the parameters of L_θ, or of the materials, as one array."""
    φ, θ = enable_gradients(problem)
    value = value_of(problem, problem.radiance, rays, row, **settings)
    if dr.grad_enabled(value):
        dr.backward(value)
    arrays = {"φ": φ, "θ": θ}[which].values()
    return np.concatenate([np.array(dr.grad(a)).ravel().astype(np.float64) for a in arrays])


def rows_of(term_names, attached):
    return {term: attached for term in term_names}


RESIDUALS = pytest.mark.parametrize(
    "terms",
    [(PRIOR,), (EXTRA,), (PRIOR, EXTRA), (PRIOR_PAIR,)],
    ids=["one", "second", "both", "pair"],
)


@RESIDUALS
@pytest.mark.parametrize("subset", [False, True])
@pytest.mark.parametrize("bounces", [1, 2])
def test_the_gradient_of_a_residual_is_that_of_both_its_sides(
    problem, rays, terms, subset, bounces
):
    sides = [
        gradient(problem, rays, rows_of(terms, attached), subset=subset, bounces=bounces)
        for attached in (Attached(lhs=True), Attached(rhs=True))
    ]
    both = gradient(problem, rays, rows_of(terms, BOTH), subset=subset, bounces=bounces)
    scale = np.abs(both).max()
    for side in sides:
        assert np.abs(side).max() > 1e-3 * scale, "a side trains nothing"
    np.testing.assert_allclose(both, sum(sides), rtol=1e-3, atol=1e-5 * scale)


@pytest.mark.parametrize(
    ("row", "bounces"),
    [
        ({PRIOR: BOTH}, 1),
        ({EXTRA: BOTH}, 1),
        ({PRIOR: BOTH, EXTRA: BOTH}, 1),
        ({PRIOR: BOTH, EXTRA: BOTH}, 3),
        ({PRIOR_PAIR: BOTH}, 1),
        ({PRIOR_PAIR: BOTH, EXTRA: BOTH}, 2),
        ({PRIOR: Attached(rhs=True), LHS: Attached(lhs=True)}, 2),
        ({PHOTOMETRIC: Attached(rhs=True)}, 1),
        ({PHOTOMETRIC: Attached(rhs=True)}, 2),
        ({PHOTOMETRIC: Attached(rhs=True), PRIOR: Attached(lhs=True)}, 1),
    ],
    ids=str,
)
@pytest.mark.parametrize("subset", [False, True])
def test_a_gradient_is_the_change_of_the_value(problem, rays, row, bounces, subset):
    """Values are polynomials of degree two in the constant: central differences are exact.

    Those of a side that is not attached are taken with the other one at rest.
    """
    constant = LearnedConstant(0.3)
    value = value_of(problem, constant, rays, row, bounces=bounces, subset=subset)
    dr.backward(value)
    found = float(dr.grad(constant.value)[0])

    edges = {LHS: Attached(lhs=True), PHOTOMETRIC: Attached(rhs=True)}
    full = {term: edges.get(term, BOTH) for term in row}

    # The terms are functions of what each side looks up.
    def value_at(left, right):
        samples = {}
        for side, c in (("lhs", left), ("rhs", right)):
            with dr.suspend_grad():
                radiance = LearnedConstant(c)
                samples[side] = traced(
                    problem, radiance, rays, full, bounces=bounces, subset=subset
                )
        return samples

    step, total = 0.05, 0.0
    for flag in ("lhs", "rhs"):
        here = {t: Attached(**{flag: True}) for t, a in row.items() if getattr(a, flag)}
        if not here:
            continue
        ends = []
        for sign in (1, -1):
            moved = {"lhs": 0.3, "rhs": 0.3} | {flag: 0.3 + sign * step}
            samples = value_at(moved["lhs"], moved["rhs"])
            ends.append(_mixed(here, samples, photographs(rays), bounces))
        total += (ends[0] - ends[1]) / (2 * step)
    assert abs(found) > 0
    np.testing.assert_allclose(found, total, rtol=2e-3)


def _mixed(terms, samples, target, bounces):
    """Values of terms whose left side is of one path sample, and the right side of another."""
    total = 0.0
    for term in terms:
        left, right = samples["lhs"], samples["rhs"]
        if term in (PRIOR, PRIOR_PAIR, EXTRA):
            number = 2 if term == EXTRA else 1
            left, right = left.learned or left, right.learned or right
            radiance = list(right.radiance)
            radiance[number - 1] = left.radiance[number - 1]
            mixed = replace(right, radiance=radiance, learned=None)
        elif term == LHS:
            mixed = left
        else:
            mixed = right
        with dr.suspend_grad():
            value = objective({term: Attached()}, mixed, target, LOSS, None, bounces)[term]
        total += float(value[0])
    return total


@pytest.mark.parametrize("terms", [(EXTRA, LHS), (PRIOR, EXTRA, LHS)], ids=["two", "three"])
def test_the_same_look_ups_have_the_same_gradient_each_time(problem, rays, terms):
    """Kernels that add to gradients of one look-up run at the same time, on several threads."""
    found = set()
    for _ in range(60):
        constant = LearnedConstant(0.3)
        row = rows_of(terms, Attached(lhs=True))
        dr.backward(value_of(problem, constant, rays, row, subset=True))
        found.add(float(f"{float(dr.grad(constant.value)[0]):.4e}"))
    assert len(found) == 1, found


def test_the_scene_is_reached_through_the_second_residual(problem, rays):
    """As through the first one: its bounce is recorded where the term attaches the scene."""
    for subset in (False, True):
        attached = gradient(problem, rays, {EXTRA: Attached(scene=True)}, "φ", subset=subset)
        assert np.abs(attached).max() > 0
        fixed = gradient(problem, rays, {EXTRA: Attached(lhs=True)}, "φ", subset=subset)
        assert not fixed.any()


def test_the_albedo_of_metals_is_none_above_one():
    """Mitsuba takes the peak of a lobe for it, which L_θ would be multiplied by."""
    metal = {"type": "roughconductor", "alpha": 0.02}
    scene = mi.load_dict({"type": "scene", "ball": {"type": "sphere", "bsdf": metal}})
    camera = Camera.look_at([0, 0, 4], [0, 0, 0], [0, 1, 0], 40, 32, 32)
    rays = pixel_rays([camera], 1, 0)
    view = SceneView.of(scene, None, 4)
    vertex = find_vertex(view, rays, mi.Bool(True), seeded(0, 32 * 32))
    plain = np.array(vertex.bsdf.eval_diffuse_reflectance(vertex.si, vertex.valid))
    found = np.array(attach_albedo(view, vertex).albedo)
    assert plain.max() > 10 and found.max() == 1 and found.min() >= 0
