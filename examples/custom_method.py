"""A method with a loss term of its own, compared with ours on a small data set.

    python examples/custom_method.py --out comparison

The term is the residual of the rendering equation at x₁, as in the radiometric prior, relative to
luminance: a saturated surface gets no extra weight in the channels in which it is dark. Both sides
of the equation are attached, so that the radiance field learns from what it predicts after a bounce
as well.
"""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path

import unbake

unbake.activate()

import drjit as dr  # noqa: E402 (importing Dr.Jit loads LLVM, which activate() finds)
import mitsuba as mi  # noqa: E402


def luminance_prior(x: unbake.TermInputs) -> mi.Float:
    """The squared residual at x₁, relative to the luminance of L_θ(x₁)."""
    residual = unbake.residual(x.sample, 1, x.lhs[0], x.rhs[1])
    luminance = mi.luminance(dr.detach(x.lhs[0]))
    weight = dr.rcp(dr.square(luminance) + x.loss.epsilon)
    return dr.mean(dr.mean(dr.square(residual) * weight))


# It reads how light scatters at x₁, and L_θ at x₁ and x₂, the two sides of the equation.
unbake.register_term(
    unbake.Term(
        "luminance_prior",
        luminance_prior,
        scene=(1,),
        lhs=(1,),
        rhs=(2,),
        title="Prior relative to luminance",
    )
)
unbake.register_method(
    unbake.Method(
        "luminance-prior",
        "prior relative to luminance, with both sides attached",
        {
            "photometric": unbake.Attached(scene=True),
            "luminance_prior": unbake.Attached(lhs=True, rhs=True),
            "lhs": unbake.Attached(lhs=True),
        },
    )
)


def main() -> None:
    """Render a small data set, fit it with both methods, and write a report on them."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder to write")
    parser.add_argument("--steps", type=int, default=300)
    parser.add_argument("--resolution", type=int, default=48)
    args = parser.parse_args()

    data = args.out / "data"
    if not data.exists():
        small = unbake.CaptureSettings(views=6, held_out=2, resolution=args.resolution, spp=32)
        unbake.capture("cornell", data, small)
    config = dataclasses.replace(unbake.preset("cpu"), steps=args.steps, pixels=512, warm_up=20)
    result = unbake.compare(
        data,
        [unbake.MethodVariant("ours"), unbake.MethodVariant("luminance-prior")],
        args.out / "comparison",
        config,
        evaluation=unbake.EvaluationSettings(spp=16, max_depth=8, train_views=0, material_spp=4),
    )
    for name, row in result["methods"].items():
        print(f"{name}: albedo {row['heldout']['albedo_psnr']:.1f} dB after {row['steps']} steps")


if __name__ == "__main__":
    main()
