"""One Mitsuba variant for the whole session, and what tests of several folders share."""

from pathlib import Path

import pytest

from unbake import backend
from unbake.errors import UserError

ROOT = Path(__file__).parents[1]


def pytest_addoption(parser):
    parser.addoption(
        "--scenes",
        type=Path,
        default=ROOT.parent / "shared" / "scenes",
        help="folder with the archives of the paper's scenes (default: %(default)s)",
    )


def pytest_configure(config):
    # Before collection: test modules import drjit, which loads LLVM at that moment.
    try:
        backend.activate()
    except UserError as error:
        pytest.exit(f"no Mitsuba variant runs here: {error}", returncode=1)


def pytest_report_header():
    import mitsuba as mi

    return f"mitsuba {mi.__version__}, {mi.variant()}"


def pytest_collection_modifyitems(items):
    import mitsuba as mi

    if mi.variant() == backend.CUDA_VARIANT:
        return
    for item in items:
        if item.get_closest_marker("gpu"):
            item.add_marker(pytest.mark.skip(reason="needs an NVIDIA GPU with OptiX"))


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the checkout."""
    return ROOT


@pytest.fixture(scope="session")
def scenes_dir(request) -> Path:
    """The folder with the paper's scenes; skips where it is absent."""
    folder = request.config.getoption("--scenes")
    if not folder.is_dir():
        pytest.skip(f"no scenes in {folder}: give their folder with --scenes")
    return folder
