"""The choice of variant and LLVM: a bad machine gets a sentence, never an abort."""

import os
import subprocess
import sys
import timeit
from pathlib import Path

import pytest
from rich.console import Console

from unbake import backend, doctor
from unbake.errors import UserError

ACTIVATE = """
from unbake import backend
from unbake.errors import UserError
try:
    print("active:", backend.activate())
except UserError as error:
    print("refused:", error)
"""
DOCTOR = "import sys; from unbake import doctor; sys.exit(doctor.main())"


def run_python(code, **environment):
    """Run code in a fresh interpreter that sees src/ and the given variables; None unsets one."""
    source = str(Path(backend.__file__).parents[1])
    variables = {**os.environ, "PYTHONPATH": source, "COLUMNS": "400", **environment}
    variables = {name: value for name, value in variables.items() if value is not None}
    return subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=120, env=variables
    )


@pytest.fixture(scope="module")
def old_llvm():
    """Path of an installed LLVM below the minimum."""
    for path in backend._installed():
        if 0 < backend._major_in_name(path) < backend.LLVM_MINIMUM:
            return path
    pytest.skip("no LLVM below the minimum is installed here")


@pytest.fixture
def without_gpu(monkeypatch):
    """A machine whose driver library does not load, for this process and its children."""
    monkeypatch.setenv("DRJIT_LIBCUDA_PATH", "/nonexistent/libcuda.so")
    monkeypatch.delenv("UNBAKE_VARIANT", raising=False)


def test_a_good_llvm_is_found_and_handed_to_drjit():
    code = (
        "import os; os.environ.pop('DRJIT_LIBLLVM_PATH', None)\n"
        "from unbake import backend; backend.activate('llvm_ad_rgb')\n"
        "import drjit as dr; llvm = backend.find_llvm()\n"
        "assert llvm.usable and llvm.version == tuple(dr.detail.llvm_version()), llvm\n"
        "assert os.environ['DRJIT_LIBLLVM_PATH'] == llvm.path"
    )
    run = run_python(code)
    assert run.returncode == 0, run.stderr


def test_importing_unbake_leaves_the_choice_of_llvm_open():
    code = "import sys, unbake; assert 'drjit' not in sys.modules"
    run = run_python(code, DRJIT_LIBLLVM_PATH=None)
    assert run.returncode == 0, run.stderr


def test_activate_again_keeps_the_variant(monkeypatch):
    import mitsuba as mi

    before = mi.variant()
    monkeypatch.setenv("UNBAKE_VARIANT", "no_such_variant")
    assert backend.activate() == before == mi.variant()


def test_environment_chooses_the_variant():
    assert "active: llvm_ad_rgb" in run_python(ACTIVATE, UNBAKE_VARIANT="llvm_ad_rgb").stdout


def test_unknown_variant_is_refused_with_the_choices():
    with pytest.raises(UserError, match=r"unknown variant 'llvm_rgb'.*cuda_ad_rgb, llvm_ad_rgb"):
        backend.activate("llvm_rgb")
    run = run_python(ACTIVATE, UNBAKE_VARIANT="llvm_rgb")
    assert "refused: UNBAKE_VARIANT: unknown variant" in run.stdout


def test_cuda_without_a_driver_is_refused(without_gpu):
    with pytest.raises(UserError, match=r"no NVIDIA driver.*or use llvm_ad_rgb"):
        backend.activate("cuda_ad_rgb")


def test_too_old_llvm_is_refused_not_aborted_on(old_llvm, without_gpu):
    run = run_python(ACTIVATE, DRJIT_LIBLLVM_PATH=old_llvm)
    assert run.returncode == 0, run.stderr
    assert "refused: DRJIT_LIBLLVM_PATH: LLVM" in run.stdout
    assert f"is too old: unbake needs {backend.LLVM_MINIMUM} or newer" in run.stdout
    assert run.stderr == ""


@pytest.mark.parametrize(
    ("path", "told"),
    [
        ("/nonexistent/libLLVM.so", "there is no file /nonexistent/libLLVM.so"),
        (__file__, "cannot be loaded as an LLVM shared library"),
        ("libm.so.6", "cannot be loaded as an LLVM shared library"),
    ],
)
def test_a_path_that_is_no_llvm_is_refused(path, told, without_gpu):
    run = run_python(ACTIVATE, DRJIT_LIBLLVM_PATH=path)
    assert run.returncode == 0, run.stderr
    assert run.stdout.startswith("refused: DRJIT_LIBLLVM_PATH: ") and told in run.stdout
    assert run.stderr == ""


def test_a_machine_without_llvm_is_told_what_to_install(monkeypatch):
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(backend, "_installed", lambda: [])
    assert backend.find_llvm() is None
    problem = backend.llvm_problem()
    assert "apt-get install libllvm19" in problem.remedy
    assert "DRJIT_LIBLLVM_PATH" in problem.remedy


def test_a_bad_choice_is_told_of_a_good_one(monkeypatch):
    good = backend.Llvm("/somewhere/libLLVM.so.19.1", (19, 1, 0))
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", "/nonexistent/libLLVM.so")
    monkeypatch.setattr(backend, "_newest_installed", lambda: good)
    assert "LLVM 19.1.0 (/somewhere/libLLVM.so.19.1)" in backend.llvm_problem().remedy


def test_drjit_imported_first_with_an_old_llvm_is_refused(old_llvm, without_gpu):
    code = f"import drjit, os\ndel os.environ['DRJIT_LIBLLVM_PATH']\n{ACTIVATE}"
    run = run_python(code, DRJIT_LIBLLVM_PATH=old_llvm)
    assert "refused: " in run.stdout, run.stderr
    assert "imported before" in run.stdout


@pytest.mark.parametrize(
    ("path", "major"),
    [
        ("/usr/lib/x86_64-linux-gnu/libLLVM.so.19.1", 19),
        ("/usr/lib/x86_64-linux-gnu/libLLVM-15.so.1", 15),
        ("/usr/lib/x86_64-linux-gnu/libLLVM-14.0.6.so.1", 14),
        ("/usr/lib/llvm-18/lib/libLLVM.so", 18),
        ("/opt/homebrew/opt/llvm@20/lib/libLLVM.dylib", 20),
        ("/opt/homebrew/opt/llvm/lib/libLLVM.dylib", 0),
        ("/Program Files/LLVM/bin/LLVM-C.dll", 0),
    ],
)
def test_major_version_by_name(path, major):
    assert backend._major_in_name(path) == major


def test_newest_usable_wins_whatever_its_name_claims(monkeypatch):
    versions = {
        "a/libLLVM.so.21.1": None,
        "b/libLLVM.so.20.1": (15, 0, 0),
        "c/libLLVM.so": (18, 1, 0),
    }
    monkeypatch.setattr(backend, "_installed", lambda: list(versions))
    monkeypatch.setattr(
        backend, "_load_llvm", lambda path: versions[path] and backend.Llvm(path, versions[path])
    )
    assert backend._newest_installed().path == "c/libLLVM.so"


def test_search_is_fast(monkeypatch):
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    assert min(timeit.repeat(backend.find_llvm, number=1, repeat=3)) < 0.3


def test_doctor_succeeds_where_tests_run():
    run = run_python(DOCTOR)
    assert run.returncode == 0, run.stdout + run.stderr
    for name in ("python", "mitsuba", "drjit", "variant", "kernels", "LLVM", "cores", "memory"):
        assert f"ok  {name} " in run.stdout
    assert "network and rays ran on" in run.stdout


def test_doctor_fails_with_the_remedy_where_llvm_is_missing(without_gpu):
    run = run_python(DOCTOR, DRJIT_LIBLLVM_PATH="/nonexistent/libLLVM.so")
    assert run.returncode == 1
    assert "!!  LLVM" in run.stdout and "-> " in run.stdout
    assert "Traceback" not in run.stdout + run.stderr


def test_doctor_survives_a_probe_that_aborts(monkeypatch):
    died = subprocess.CompletedProcess([], -6, stdout="", stderr="Cannot select: fmaximum\n")
    monkeypatch.setattr(doctor.subprocess, "run", lambda *_, **__: died)
    diagnosis = doctor.doctor()
    assert not diagnosis.usable
    kernels = next(row for row in diagnosis.rows if row.name == "kernels")
    assert "SIGABRT" in kernels.value and "fmaximum" in kernels.value and kernels.remedy
    with Console(quiet=True) as console:
        assert doctor.print_doctor(console) == 1


@pytest.mark.gpu
def test_cuda_is_chosen_where_it_runs():
    run = run_python(ACTIVATE, UNBAKE_VARIANT=None)
    assert "active: cuda_ad_rgb" in run.stdout, run.stderr


@pytest.mark.parametrize(
    ("number", "visible", "seen"),
    [
        ("0", None, "0"),
        ("3", None, "1"),
        (None, None, None),
        ("1", "4,6,7", "6"),
        ("1", "GPU-a,GPU-b", "GPU-b"),
        ("1", "5", "5"),
        ("1", "", ""),
        ("many", None, None),
    ],
)
def test_processes_of_a_machine_take_its_gpus_in_turn(number, visible, seen, monkeypatch, tmp_path):
    for name in backend.LOCAL_RANKS:
        monkeypatch.delenv(name, raising=False)
    for gpu in ("0000:01:00.0", "0000:02:00.0"):
        (tmp_path / gpu).mkdir()
    monkeypatch.setattr(backend, "GPUS", tmp_path)
    # Set first, so that what the test changes is taken back.
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible or "")
    if visible is None:
        monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
    if number is not None:
        monkeypatch.setenv("MPI_LOCALRANKID", number)
    backend._take_a_gpu()
    assert os.environ.get("CUDA_VISIBLE_DEVICES") == seen
