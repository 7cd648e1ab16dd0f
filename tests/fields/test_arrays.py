"""The function that bounds fields, and its gradients."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from unbake.fields.arrays import sigmoid


def gradient(values, least_slope, of_value):
    """What arrives at numbers, of gradients of their bounded values."""
    x = mi.Float(values)
    dr.enable_grad(x)
    y = sigmoid(x, least_slope)
    dr.backward(dr.dot(y, mi.Float(of_value)))
    return y.numpy(), dr.grad(x).numpy()


def test_the_least_slope_is_one_of_gradients_alone():
    x = np.array([-30, -6.5, -5, -1, 0, 2, 5, 6.5, 30], np.float32)
    values, slopes = gradient(x, 0.0, np.ones(9))
    expected = 1 / (1 + np.exp(-x.astype(np.float64)))
    np.testing.assert_allclose(values, expected, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(slopes, expected * (1 - expected), rtol=1e-4, atol=1e-7)
    np.testing.assert_array_equal(gradient(x, 0.01, np.ones(9))[0], values)
    np.testing.assert_array_equal(sigmoid(mi.Float(x), 0.01).numpy(), values)


@pytest.mark.parametrize("side", [-1, 1])
def test_numbers_come_back_from_far_away_but_do_not_run_away(side):
    x = side * np.array([20, 6.5, 5.5, 2], np.float32)
    own = gradient(x, 0.0, np.ones(4))[1]
    back = gradient(x, 0.01, side * np.ones(4))[1]  # a descent moves towards 0
    np.testing.assert_allclose(back * side, [0.01, 0.01, 0.01, own[3]], rtol=1e-5)
    away = gradient(x, 0.01, -side * np.ones(4))[1]
    np.testing.assert_allclose(away * -side, [own[0], own[1], 0.01, own[3]], rtol=1e-4, atol=1e-7)


def test_forward_gradients_are_those_of_the_function():
    x = mi.Float([-7, 0, 7])
    dr.enable_grad(x)
    dr.set_grad(x, 1)
    y = sigmoid(x, 0.01)
    dr.forward_to(y)
    expected = y.numpy() * (1 - y.numpy())
    np.testing.assert_allclose(dr.grad(y).numpy(), expected, rtol=1e-4)


def test_a_descent_leaves_a_bound_that_it_was_thrown_at():
    def after(least_slope):
        optimizer = mi.ad.Adam(0.1, {"x": mi.Float(-14)})
        for _ in range(300):
            value = sigmoid(optimizer["x"], least_slope)
            noise = dr.opaque(mi.Float, 1e-6)  # as large as gradients that vanish
            dr.backward(dr.sum(dr.square(value - 0.2)) + noise * optimizer["x"])
            optimizer.step()
        return sigmoid(optimizer["x"])[0]

    assert after(0.01) == pytest.approx(0.2, abs=1e-3)
    assert after(0.0) < 1e-3
