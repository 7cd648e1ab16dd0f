"""Prove that this machine runs what unbake needs: `python -m unbake.probe`.

Runs apart from the process that asks, because a bad LLVM or driver aborts instead of raising. The
last line it prints is a JSON object with `variant`, `device` and `seconds`, or with `error`.
"""

from __future__ import annotations

import json
import sys
import time
from typing import TYPE_CHECKING

from unbake import backend
from unbake.errors import UserError

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


def main() -> int:
    """Run both checks on the variant `unbake` would choose; 0 where they agree with NumPy."""
    try:
        variant = backend.activate()
        start = time.perf_counter()
        _check_network()
        _check_rays()
    except UserError as error:
        print(json.dumps({"error": str(error)}))
        return 1
    seconds = time.perf_counter() - start
    print(json.dumps({"variant": variant, "device": _device(variant), "seconds": seconds}))
    return 0


def _check_network() -> None:
    """Run a small network forward and backward as tensors, the way the fields do on a CPU."""
    import drjit as dr
    import mitsuba as mi
    import numpy as np
    from drjit import nn

    net = nn.Sequential(nn.Linear(3, 16), nn.ReLU(), nn.Linear(16, 1))
    net = net.alloc(mi.TensorXf, 3, rng=dr.rng(seed=0))
    points = np.linspace(-1, 1, 3 * 64, dtype=np.float32).reshape(3, 64)
    weights = {name: np.array(value) for name, value in net.items()}
    x = mi.TensorXf(points)
    dr.enable_grad(x)
    y = net(x)
    dr.backward(dr.sum(y))

    hidden = weights["layers.0.weights"] @ points + weights["layers.0.bias"].reshape(-1, 1)
    last = weights["layers.2.weights"]
    expected = last @ np.maximum(hidden, 0) + weights["layers.2.bias"].reshape(-1, 1)
    gradient = weights["layers.0.weights"].T @ (last.T * (hidden > 0))
    _agree("a network's output", np.array(y), expected)
    _agree("a network's gradient", np.array(dr.grad(x)), gradient)


def _check_rays() -> None:
    """Trace rays at a unit square: Embree on a CPU, OptiX on a GPU."""
    import mitsuba as mi
    import numpy as np

    scene = mi.load_dict({"type": "scene", "square": {"type": "rectangle"}})
    x = mi.Float([-0.5, 0.5, 1.5])
    hits = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, 0, 2), mi.Vector3f(0, 0, -1)))
    _agree("the distance along a ray", np.array(hits.t), np.array([2.0, 2.0, np.inf]))


def _agree(name: str, got: ArrayLike, expected: ArrayLike) -> None:
    import numpy as np

    if not np.allclose(got, expected, rtol=1e-3, atol=1e-4):
        raise UserError(f"{name} came out wrong", remedy="Update the driver or LLVM")


def _device(variant: str) -> str:
    import drjit as dr

    if variant == backend.LLVM_VARIANT:
        return f"LLVM {'.'.join(map(str, dr.detail.llvm_version()))}, {dr.thread_count()} threads"
    return f"CUDA {'.'.join(map(str, dr.detail.cuda_version()))}"


if __name__ == "__main__":
    sys.exit(main())
