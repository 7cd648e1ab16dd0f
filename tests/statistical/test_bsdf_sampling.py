"""Directions that BSDFs with unknown materials sample, by Mitsuba's own χ² test.

The density must be that of the samples with whatever values fields have, and both must read the
same values: in our transport those that travel on the surface interaction, in Mitsuba's those that
textures ask the fields for.
"""

import drjit as dr
import mitsuba as mi
import pytest
from support import random_values, tiny_fields

from unbake.fields.materials import carry, make_materials
from unbake.fields.registry import representations
from unbake.fields.texture import material_textures

#: Towards the camera, in the frame of the surface.
DIRECTIONS = [(0, 0, 1), (0.6, 0, 0.8), (0.3, -0.8, 0.52), (-0.9, 0.1, 0.42), (0, 0.98, 0.2)]
REPRESENTATIONS = representations()
WRAPPERS = {
    "alone": lambda bsdf: bsdf,
    "twosided": lambda bsdf: {"type": "twosided", "bsdf": bsdf},
    "normalmap": lambda bsdf: {
        "type": "normalmap",
        "normalmap": {"type": "rgb", "value": [0.6, 0.45, 0.9]},
        "bsdf": bsdf,
    },
}


def surface(materials, wi, lanes: int, carried: bool) -> mi.SurfaceInteraction3f:
    """Points on a surface that all are one."""
    si = dr.zeros(mi.SurfaceInteraction3f, lanes)
    si.t, si.p, si.uv = mi.Float(1), mi.Point3f(0.3, 0.6, 0.2), mi.Point2f(0.7, 0.4)
    si.sh_frame = si.sh_frame.__class__(mi.Normal3f(0, 0, 1))
    si.n, si.wi = mi.Normal3f(0, 0, 1), dr.normalize(mi.Vector3f(*wi))
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    if carried:
        carry(si, materials.evaluate(si, mi.Bool(True)))
    return si


def make_bsdf(representation: str, wrapper: str, carried: bool, seed: int):
    """A BSDF whose albedo, roughness and metallic are fields with random parameters."""
    config = tiny_fields(representation)
    names = ("albedo", "roughness")
    settings = {name: config.material_settings[name] for name in names}
    materials = make_materials(representation, settings, ["paint"], seed=seed)
    materials.assign(random_values(materials, seed))
    if not carried:
        materials.stand_alone()
    paint = {"type": "principled", "metallic": 0.3, **material_textures(materials)}
    return materials, mi.load_dict(WRAPPERS[wrapper](paint))


def chi_square(materials, bsdf, wi, carried, density=None) -> tuple[bool, str]:
    """Whether Mitsuba accepts that a density is that of the samples, over all these tests."""
    ctx = mi.BSDFContext()

    def sample(u):
        si = surface(materials, wi, dr.width(u), carried)
        bs, weight = bsdf.sample(ctx, si, u[0], mi.Point2f(u[1], u[2]))
        return bs.wo, dr.select(dr.all(weight == 0), 0.0, mi.Float(1))

    def pdf(wo):
        si = surface(materials, wi, dr.width(wo), carried)
        return (density or bsdf.pdf)(ctx, si, wo)

    test = mi.chi2.ChiSquareTest(
        domain=mi.chi2.SphericalDomain(),
        sample_func=sample,
        pdf_func=pdf,
        sample_dim=3,
        sample_count=200_000,
        res=33,
        ires=16,
    )
    count = len(DIRECTIONS) * len(CASES)
    return test.run(significance_level=0.01, test_count=count, quiet=True), test.messages


CASES = [
    *((representation, "alone", True) for representation in REPRESENTATIONS),
    ("neural", "alone", False),
    ("grid", "twosided", True),
    ("grid", "normalmap", True),
]


@pytest.mark.parametrize(("representation", "wrapper", "carried"), CASES)
def test_directions_are_sampled_as_their_density_says(representation, wrapper, carried):
    materials, bsdf = make_bsdf(representation, wrapper, carried, seed=3)
    for wi in DIRECTIONS:
        accepted, messages = chi_square(materials, bsdf, wi, carried)
        assert accepted, f"{wi}: {messages}"


def test_the_density_of_another_material_is_rejected():
    materials, bsdf = make_bsdf("grid", "alone", True, seed=3)
    _, other = make_bsdf("grid", "alone", True, seed=3)
    params = mi.traverse(other)
    params["metallic.value"] = 0.5
    params.update()
    accepted, _ = chi_square(materials, bsdf, DIRECTIONS[1], True, other.pdf)
    assert not accepted
