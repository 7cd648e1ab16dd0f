"""One Mitsuba variant for the whole session, and what tests of several folders share."""

import os
import signal
import sys
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import pytest

from unbake import backend, signals
from unbake.errors import UserError
from unbake.quantities import QUANTITIES

ROOT = Path(__file__).parents[1]

# Kernels that tests compile are kept by content, in a folder that processes and checkouts share.
# Dr.Jit 1.5 sweeps its own folder at 100 MB, which the tests alone would fill.
_CACHE = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
os.environ.setdefault("DRJIT_CACHE_DIR", str(_CACHE / "unbake" / "test-kernels"))
os.environ.setdefault("DRJIT_CACHE_MAXSIZE", str(1 << 30))

# Test modules import `support`; pytest's importlib mode puts no folder on the path.
sys.path.insert(0, str(Path(__file__).parent))


# Programs that tests start inherit which signals are ignored: in the background of a shell or by
# nohup, some are.
for number in signals.STOPPING:
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, signal.SIG_DFL)


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


@dataclass(frozen=True)
class Outcome:
    """What a command line did: exit status, and what it printed where."""

    status: int
    out: str
    err: str


@pytest.fixture
def unbake(monkeypatch, capfd):
    """Call the command line in this process: `unbake("fit", data, "--out", run)`."""
    from unbake import cli

    def call(*words) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["unbake", *map(str, words)])
        capfd.readouterr()
        with pytest.raises(SystemExit) as stop:
            cli.main()
        return Outcome(stop.value.code, *capfd.readouterr())

    return call


@dataclass
class Clock:
    """The clock that lines of progress look at; it goes on by `step` seconds with each look."""

    now: float = 0.0
    step: float = 0.0

    def monotonic(self) -> float:
        self.now += self.step
        return self.now


@pytest.fixture
def clock(monkeypatch):
    """A clock for lines of progress that stands still until a test moves it."""
    from unbake import progress

    made = Clock()
    monkeypatch.setattr(progress, "time", made)
    return made


@pytest.fixture(scope="session")
def cornell(tmp_path_factory) -> Path:
    """A captured data set, to be read alone: two views and a held-out one, 16 x 16 pixels."""
    from unbake.acquisition.capture import capture
    from unbake.acquisition.settings import CaptureSettings

    folder = tmp_path_factory.mktemp("captured") / "cornell"
    small = CaptureSettings(views=2, held_out=1, resolution=16, spp=8, max_depth=6)
    capture("cornell", folder, small, tell=lambda line: None)
    return folder


@pytest.fixture(scope="session")
def tiny(tmp_path_factory) -> Path:
    """A settings file of a fit that takes seconds: small networks, few samples, 30 steps."""
    grid = "levels = 2\ntable_log2 = 8\nbase_resolution = 2\n"
    fields = "".join(
        f"[{name}.neural]\nwidth = 8\nhidden = 1\n[{name}.neural.grid]\n{grid}"
        for name in (*(f"materials.{name}" for name in QUANTITIES), "radiance")
    )
    file = tmp_path_factory.mktemp("settings") / "tiny.toml"
    file.write_text("steps = 30\npixels = 64\nspp = 4\nwarm_up = 0\n" + fields)
    return file


@pytest.fixture(scope="session")
def built_in(tmp_path_factory):
    """Write a built-in scene, once for each albedo: `built_in(name, albedo)` is its path."""
    from unbake.acquisition import built_in

    folder = tmp_path_factory.mktemp("built-in")

    @cache
    def write(name: str, albedo: float = 0.5) -> Path:
        return built_in.write_scene(name, folder / f"{name}-{albedo}", albedo=albedo)

    return write


@pytest.fixture
def one_thread():
    """A test on one thread: see `support.one_thread`."""
    import support

    with support.one_thread():
        yield
