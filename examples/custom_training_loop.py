"""A training loop of its own: other pixels, another loss, two optimisers that take turns.

    python examples/custom_training_loop.py DATA --steps 300

`unbake.fit` does more: it replays a recorded step, and writes checkpoints and a log. This loop is
traced anew in each step, which is slower and free to change from step to step.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import unbake

unbake.activate()

import drjit as dr  # noqa: E402 (importing Dr.Jit loads LLVM, which activate() finds)
import mitsuba as mi  # noqa: E402
import numpy as np  # noqa: E402

COUNT, SPP, EPSILON = 256, 4, 1e-2
# What the loop reads of a path: one differentiable bounce, L_θ at x₁ with gradients and at x₂
# without.
PIECES = unbake.Requirements(1, 1, attached=frozenset({1}), constant=frozenset({2}))


def draw(
    photographs: unbake.Photographs, rng: np.random.Generator
) -> tuple[unbake.PixelBatch, mi.Float]:
    """Half of the pixels by their brightness, half uniformly; and weights that make up for it."""
    brightness = photographs.table[:, :3].mean(-1).clip(0)
    density = 0.5 * brightness / brightness.sum() + 0.5 / len(brightness)
    numbers = rng.choice(len(density), COUNT, p=density / density.sum())
    weight = 1 / (len(density) * density[numbers])
    batch = unbake.PixelBatch.of(numbers, photographs.table[numbers])
    return batch, mi.Float(weight.astype(np.float32))


def losses(sample: unbake.PathSample, target: mi.Color3f, weight: mi.Float) -> list[mi.Float]:
    """The squared error of the image, which trains φ, and the residual at x₁, which trains θ."""
    image = unbake.rhs(sample, dr.detach(sample.radiance[1]))
    relative = weight / (dr.square(mi.luminance(target)) + EPSILON)
    photometric = unbake.squared_error(image, target, SPP, mi.Color3f(relative))
    known = dr.detach(sample)  # the residual trains the radiance field alone
    residual = unbake.residual(known, 1, sample.radiance[0], known.radiance[1])
    return [photometric, unbake.residual_norm(residual, sample.radiance[0], EPSILON)]


def train(data: Path, steps: int) -> list[float]:
    """The sum of the losses, step by step."""
    dataset = unbake.Dataset.load(data)
    config = unbake.with_defaults(unbake.preset("cpu"), dataset)
    pixels = unbake.training_pixels(dataset, clip_negative=False, smoothed=False)
    scale = pixels.photographs.level
    problem = unbake.make_problem(dataset.scene, dataset.background, config, scale)
    phi = mi.ad.Adam(5e-3, problem.parameters(), mask_updates=True)
    theta = mi.ad.Adam(1e-2, problem.radiance.parameters(), mask_updates=True)
    rng, sampler = np.random.default_rng(0), mi.load_dict({"type": "independent"})
    history = []
    for step in range(steps):
        problem.assign(dict(phi.items()))
        problem.radiance.assign(dict(theta.items()))
        drawn, weight = draw(pixels.photographs, rng)
        sampler.seed(step, COUNT * SPP)
        batch = drawn.batch(pixels.rays, sampler, SPP)
        view, hidden = problem.scene_view, problem.hide_emitters
        sample = unbake.trace(
            view, problem.radiance, batch.ray, sampler, PIECES, hide_emitters=hidden
        )
        total = sum(losses(sample, batch.target, weight))
        dr.backward(total)
        # The radiance field learns in each step, the materials in every second one.
        for optimizer in (theta, phi)[: 1 + step % 2]:
            optimizer.step()
        for optimizer in (theta, phi):
            dr.clear_grad(dict(optimizer.items()))
        history.append(float(total[0]))
        if step % 10 == 0:
            print(f"step {step}: loss {history[-1]:.4f}")
    return history


def main() -> None:
    """Train on a data set of `unbake capture`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("--steps", type=int, default=300)
    args = parser.parse_args()
    history = train(args.data, args.steps)
    part = max(1, len(history) // 4)
    print(f"mean loss {np.mean(history[:part]):.4f} at first, {np.mean(history[-part:]):.4f} last")


if __name__ == "__main__":
    main()
