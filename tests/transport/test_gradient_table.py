"""Who is trained by what, cell by cell: a gradient is exactly zero or it is there (Sec. 4.1)."""

import itertools
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import built_in_cameras, enable_gradients, pieces, pixel_rays, seeded

from unbake.transport.loss import RelativeL2
from unbake.transport.methods import (
    EXTRA,
    LHS,
    METHODS,
    PHOTOMETRIC,
    PRIOR,
    PRIOR_PAIR,
    Attached,
)
from unbake.transport.objective import objective, requirements
from unbake.transport.path_sample import trace

SPP = 4
#: Term → flag of `Attached` → the piece of a path sample that it makes live.
EDGES = {
    PHOTOMETRIC: {"scene": "bounce1", "rhs": "L2"},
    PRIOR: {"scene": "bounce1", "lhs": "L1", "rhs": "L2"},
    PRIOR_PAIR: {"scene": "bounce1", "lhs": "L1", "rhs": "L2"},
    EXTRA: {"lhs": "L2"},
    LHS: {"lhs": "L1"},
}
ROWS = {name: method.terms for name, method in METHODS.items()}
ROWS["ours, one-bounce"] = METHODS["ours"].without_extra_bounce().terms
PIECES = ("bounce1", "L1", "L2")
FLAGS = ("scene", "lhs", "rhs")
SYNTHETIC = [
    pytest.param(term, Attached(**dict(zip(EDGES[term], on, strict=True))), id=f"{term}-{on}")
    for term in EDGES
    for on in itertools.product([False, True], repeat=len(EDGES[term]))
]
LOSSES = {"photograph": RelativeL2(0.01)}


@pytest.fixture(scope="module")
def rays():
    return pixel_rays(built_in_cameras("cornell", 6), SPP, seed=1)


def traced(problem, rays, wanted=None):
    wanted = wanted or pieces(1, 2)
    sampler = seeded(2, dr.width(rays))
    radiance = problem.radiance if wanted.radiance else None
    return trace(
        problem.scene_view, radiance, rays, sampler, wanted, hide_emitters=problem.hide_emitters
    )


def photographs(rays):
    return mi.Color3f(0.1 + 0.3 * dr.arange(mi.Float, dr.width(rays) // SPP) / 36)


def non_zero(arrays):
    """Of each array, whether any entry of its gradient is other than zero."""
    gradients = [np.array(dr.grad(a)).ravel() for a in arrays]
    assert all(np.isfinite(g).all() for g in gradients)
    return [bool((g != 0).any()) for g in gradients]


# ------------------------------------------------- pieces of a path sample, for rows yet to come


def with_live_pieces(sample):
    """A path sample whose pieces up to L(x₂) take gradients, and the arrays of each piece.

    Those of a second bounce from x₁ are arrays of the same pieces.
    """
    sample = dr.detach(sample)
    step = live_bounce(sample)
    L1, L2, L3 = (mi.Color3f(L) for L in sample.radiance)
    arrays = {"bounce1": [step.direct, step.weight], "L1": [L1], "L2": [L2]}
    pair = sample.pair
    if pair is not None:
        again, L2_again = live_bounce(pair), mi.Color3f(pair.radiance[1])
        pair = replace(pair, bounces=[again], radiance=[pair.radiance[0], L2_again])
        arrays["bounce1"] += [again.direct, again.weight]
        arrays["L2"].append(L2_again)
    sample = replace(sample, bounces=[step, sample.bounces[1]], radiance=[L1, L2, L3], pair=pair)
    dr.enable_grad(arrays)
    return sample, arrays


def live_bounce(sample):
    """A copy of the first bounce, with arrays of its own."""
    step = sample.bounces[0]
    return replace(step, direct=mi.Color3f(step.direct), weight=mi.Color3f(step.weight))


def test_nothing_beyond_the_second_vertex_passes_gradients(problem, rays):
    enable_gradients(problem)
    sample = traced(problem, rays)
    first, second = sample.bounces
    for attached in (first.direct, first.weight, *sample.radiance[:2]):
        assert dr.grad_enabled(attached)
    for fixed in (second.direct, second.weight, sample.radiance[2], sample.x1.albedo):
        assert not dr.grad_enabled(fixed)
    assert sample.pair is None, "a second bounce that no term reads"


@pytest.mark.parametrize("reference", LOSSES)
@pytest.mark.parametrize(("term", "attached"), SYNTHETIC)
def test_a_row_makes_those_pieces_live_that_it_says(problem, rays, term, attached, reference):
    wanted = replace(pieces(1, 2), pair=term == PRIOR_PAIR)
    sample, arrays = with_live_pieces(traced(problem, rays, wanted))
    assert len(arrays["bounce1"]) == (4 if term == PRIOR_PAIR else 2)
    values = objective({term: attached}, sample, photographs(rays), LOSSES[reference])
    assert list(values) == [term]
    if dr.grad_enabled(values[term]):
        dr.backward(values[term])
    wanted = {piece for flag, piece in EDGES[term].items() if getattr(attached, flag)}
    for piece in PIECES:
        assert non_zero(arrays[piece]) == [piece in wanted] * len(arrays[piece]), piece


def test_live_edges_add_up(problem, rays):
    """A term's gradient is the sum of those through each of its live edges."""

    def gradients(attached):
        sample, arrays = with_live_pieces(traced(problem, rays))
        dr.backward(
            objective({PRIOR: attached}, sample, photographs(rays), LOSSES["photograph"])[PRIOR]
        )
        return np.concatenate([np.ravel(dr.grad(a)) for p in PIECES for a in arrays[p]])

    parts = [gradients(Attached(**{flag: True})) for flag in FLAGS]
    np.testing.assert_array_equal(sum(parts), gradients(Attached(True, True, True)))


# ------------------------------------------------------ parameters of the fields, for each method


@pytest.mark.parametrize(("method", "term"), [(m, t) for m, row in ROWS.items() for t in row])
@pytest.mark.parametrize("reference", LOSSES)
@pytest.mark.parametrize("two_pass", [False, True], ids=["one-pass", "two-pass"])
def test_a_term_of_a_method_trains_what_the_table_says(
    problem, rays, method, term, reference, two_pass
):
    row = ROWS[method]
    φ, θ = enable_gradients(problem)
    target = photographs(rays)
    sample = traced(problem, rays, requirements(row))
    primal = target + 0.1 if two_pass else None
    value = objective(row, sample, target, LOSSES[reference], primal)[term]
    dr.backward(value)

    attached = [flag for flag in EDGES[term] if getattr(row[term], flag)]
    trains_φ, trains_θ = "scene" in attached, bool({"lhs", "rhs"} & set(attached))
    assert trains_φ or trains_θ, "a term that trains nothing has no place in the table"
    assert non_zero(φ.values()) == [trains_φ] * len(φ)
    assert non_zero(θ.values()) == [trains_θ] * len(θ)


@pytest.mark.parametrize("method", ROWS)
def test_flags_without_an_edge_are_not_set(method):
    """A row must not promise what the objective does not do."""
    for term, attached in ROWS[method].items():
        for flag in set(FLAGS) - set(EDGES[term]):
            assert not getattr(attached, flag), f"{method}, {term}: {flag} has no effect"


@pytest.mark.parametrize("method", ["ours", "ours, one-bounce"])
def test_the_paper_trains_materials_by_photographs_and_radiance_by_all_else(method):
    """Sec. 4.1: the photometric loss trains φ alone, prior and LHS loss θ alone."""
    row = ROWS[method]
    assert row[PHOTOMETRIC] == Attached(scene=True)
    others = set(row) - {PHOTOMETRIC}
    assert {PRIOR, LHS} <= others
    assert all(row[term] == Attached(lhs=True) for term in others)


@pytest.mark.parametrize("row", [{PRIOR: Attached(lhs=True)}, {EXTRA: Attached(lhs=True)}])
def test_a_row_of_a_single_residual_asks_for_the_radiance_field(row):
    assert requirements(row).radiance
    assert requirements(row).residuals == (2 if EXTRA in row else 1)


@pytest.mark.parametrize("method", ROWS)
def test_a_second_bounce_is_traced_for_the_product_of_residuals_alone(method):
    wanted = requirements(ROWS[method])
    assert wanted.pair == (PRIOR_PAIR in ROWS[method]) == (method == "with-prior")
    assert not wanted.pair_attached
    assert requirements({PRIOR_PAIR: Attached(rhs=True)}).pair_attached


def test_the_product_of_residuals_leaves_the_other_samples_as_they_are(problem, rays):
    """The second bounce is drawn last: all that other terms read is the same number for number."""
    row = METHODS["ours"].terms
    alone = traced(problem, rays, requirements(row))
    beside = traced(problem, rays, requirements({**row, PRIOR_PAIR: Attached(scene=True)}))
    target = photographs(rays)
    values = [objective(row, sample, target, LOSSES["photograph"]) for sample in (alone, beside)]
    for term in row:
        assert float(values[0][term][0]) == float(values[1][term][0]), term
    first, second = beside.bounces[0].next.si.p, beside.pair.bounces[0].next.si.p
    hit = np.array(beside.bounces[0].next.valid & beside.pair.bounces[0].next.valid)
    assert hit.mean() > 0.5
    assert (np.array(dr.norm(first - second))[hit] > 1e-4).all(), "the same bounce twice"
