"""The guide draws directions as its density says, and learns where light comes from."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import random_values, seeded

from unbake.errors import UserError
from unbake.fields.domain import Domain
from unbake.fields.guide import Choice, LightGuide
from unbake.fields.settings import GuideConfig

SIZES = GuideConfig(cells=2, bands=4, sectors=8)
DOMAIN = Domain((1.0, 2.0, 3.0), 4.0)


def random_guide(seed=1) -> LightGuide:
    guide = LightGuide(SIZES, DOMAIN)
    guide.assign(random_values(guide, seed, 0.2))
    guide.prepare()
    return guide


def test_directions_are_drawn_as_their_density_says():
    guide = random_guide()
    for cell in (0, 21, 47):
        test = mi.chi2.ChiSquareTest(
            domain=mi.chi2.SphericalDomain(),
            sample_func=lambda u, cell=cell: guide.sample(mi.UInt32(cell), mi.Point2f(u)),
            pdf_func=lambda wo, cell=cell: guide.pdf(mi.UInt32(cell), wo),
            sample_dim=2,
            sample_count=200_000,
            res=64,
            ires=4,
        )
        assert test.run(significance_level=0.01, test_count=3, quiet=True), test.messages


def test_the_density_of_another_cell_is_another():
    guide = random_guide()
    direction = mi.Vector3f(0, 0.6, 0.8)
    found = np.array(guide.pdf(dr.arange(mi.UInt32, 48), direction))
    assert found.min() > 0 and len(np.unique(found)) == 48


def test_cells_tell_places_and_normals_apart():
    guide = LightGuide(SIZES, DOMAIN)

    def cell(p, n, valid=True):
        return int(guide.cell(mi.Point3f(p), mi.Normal3f(n), mi.Bool(valid))[0])

    normals = [(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0.6, 0.8), (0.5, -0.5, -0.7)]
    corners = [(x, y, z) for x in (0, 2) for y in (1, 3) for z in (2, 4)]
    assert sorted(cell(p, n) for p in corners for n in normals) == list(range(48))
    # Outside of the cube, and at no point at all
    assert 0 <= cell((1e9, -1e9, 3), (0, 0, 1)) < 48
    assert cell((np.nan, 0, 0), (np.nan, 0, 0), False) == 0


def learn(guide: LightGuide, bright: float, steps: int, pdf: float = 0.08) -> None:
    """Steps in which light comes from the half of the sphere with `bright` · z > 0."""
    optimizer, n = mi.ad.Adam(0.01, guide.parameters()), 2048
    for step in range(steps):
        guide.assign(dict(optimizer.items()))
        guide.prepare()
        sampler = seeded(step, n)
        cell = mi.UInt32(7) + dr.zeros(mi.UInt32, n)
        d = mi.warp.square_to_uniform_sphere(sampler.next_2d())
        # Of a BSDF that scatters everywhere alike
        choice = Choice(cell, d, mi.Float(pdf))
        dr.backward(guide.loss(choice, dr.select(bright * d.z > 0, mi.Float(2), 0)))
        optimizer.step()
    guide.assign(dict(optimizer.items()))
    guide.prepare()


def test_it_learns_where_light_comes_from_and_learns_anew_where_light_has_changed():
    guide = LightGuide(SIZES, DOMAIN)
    up, down = (mi.Vector3f(0.6, 0, z) for z in (0.8, -0.8))
    cell = mi.UInt32(7)
    before = float(guide.share(cell)[0])
    learn(guide, 1.0, 60)
    assert guide.pdf(cell, up)[0] > 5 * guide.pdf(cell, down)[0] > 0
    # It knows better than this BSDF, and draws more often.
    assert guide.share(cell)[0] > before + 0.05
    other = np.array(guide.pdf(mi.UInt32(8), up))
    np.testing.assert_allclose(other, 1 / (4 * np.pi), rtol=1e-5)
    learn(guide, -1.0, 400)
    assert guide.pdf(cell, down)[0] > 5 * guide.pdf(cell, up)[0] > 0


def test_it_draws_less_often_where_the_bsdf_knows_better():
    guide = LightGuide(SIZES, DOMAIN)
    before = float(guide.share(mi.UInt32(7))[0])
    learn(guide, 1.0, 60, pdf=3.0)
    assert guide.share(mi.UInt32(7))[0] < before - 0.05


@pytest.mark.parametrize("pdf", [0.0, np.nan, np.inf])
def test_samples_without_light_teach_nothing(pdf):
    guide = random_guide()
    values = guide.parameters()
    dr.enable_grad(*values.values())
    cell = dr.arange(mi.UInt32, 48)
    choice = Choice(cell, mi.Vector3f(0, 0, 1), dr.opaque(mi.Float, pdf, 48))
    loss = guide.loss(choice, dr.opaque(mi.Float, 0, 48))
    dr.backward(loss)
    assert loss[0] == 0
    assert all(dr.all(dr.grad(value) == 0) for value in values.values())


@pytest.mark.parametrize("sizes", [{"cells": -1}, {"bands": 0}, {"sectors": 129}])
def test_sizes_that_cannot_be_are_refused(sizes):
    with pytest.raises(UserError, match=next(iter(sizes))):
        GuideConfig(**sizes)
