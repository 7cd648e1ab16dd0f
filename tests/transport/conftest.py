"""What tests of light transport share."""

import pytest


@pytest.fixture(scope="module")
def problem(built_in):
    """Unknown materials and L_θ of a small room, with tiny networks, before any training."""
    from support import TINY_FIT

    from unbake.training.problem import make_problem

    return make_problem(built_in("cornell"), "visible", TINY_FIT, 0.2)
