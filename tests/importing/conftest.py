"""A captured data set and its meshes, which imports are compared with."""

import pytest

from unbake.dataset.views import Dataset


@pytest.fixture
def captured(cornell):
    return Dataset.load(cornell)


@pytest.fixture
def meshes(cornell):
    found = sorted((cornell / "scene" / "meshes").glob("*.ply"))
    assert len(found) > 3
    return found
