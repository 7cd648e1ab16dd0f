"""Which Mitsuba variant runs, and on which LLVM.

Dr.Jit loads LLVM the moment it is imported, and an LLVM that is too old aborts the whole process at
the first tensor kernel. So the library is chosen here, before that import, and checked after it.
Nothing in this module imports Mitsuba or Dr.Jit until `activate` is called.
"""

from __future__ import annotations

import ctypes
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from unbake.errors import UserError
from unbake.threads import usable_cores

LLVM_MINIMUM = 17
"""Oldest LLVM accepted, as a major version: 15 aborts in tensor mode (cannot select fmaximum)."""

CUDA_VARIANT = "cuda_ad_rgb"
LLVM_VARIANT = "llvm_ad_rgb"
VARIANTS = (CUDA_VARIANT, LLVM_VARIANT)

#: What `mpiexec` and Slurm tell a process: which one of its machine it is, from 0.
LOCAL_RANKS = (
    "MPI_LOCALRANKID",
    "OMPI_COMM_WORLD_LOCAL_RANK",
    "MV2_COMM_WORLD_LOCAL_RANK",
    "SLURM_LOCALID",
)
#: Where NVIDIA's driver lists the GPUs of a machine, on Linux.
GPUS = Path("/proc/driver/nvidia/gpus")
_VISIBLE = "CUDA_VISIBLE_DEVICES"
_LLVM_PATH = "DRJIT_LIBLLVM_PATH"
_LLVM_REMEDY = (
    f"Install LLVM {LLVM_MINIMUM} or newer (Debian, Ubuntu: apt-get install libllvm19; "
    "Fedora: dnf install llvm-libs; macOS: brew install llvm), "
    f"or set {_LLVM_PATH} to the shared library of one"
)
_PLACES = {
    "linux": (
        "/usr/lib/*/libLLVM*.so*",
        "/usr/lib/libLLVM*.so*",
        "/usr/lib64/libLLVM*.so*",
        "/usr/lib/llvm*/lib*/libLLVM*.so*",
        "/usr/lib/llvm/*/lib*/libLLVM*.so*",
        "/usr/lib64/llvm*/lib*/libLLVM*.so*",
        "/usr/local/lib*/libLLVM*.so*",
    ),
    "darwin": (
        "/opt/homebrew/opt/llvm*/lib/libLLVM*.dylib",
        "/usr/local/opt/llvm*/lib/libLLVM*.dylib",
        "/opt/local/libexec/llvm-*/lib/libLLVM*.dylib",
    ),
    "win32": ("/Program Files/LLVM/bin/LLVM-C.dll", "/msys64/*/bin/libLLVM*.dll"),
}


@dataclass(frozen=True)
class Llvm:
    """One LLVM shared library: `path` as Dr.Jit is given it, `version` as the library states it."""

    path: str
    version: tuple[int, int, int]

    @property
    def usable(self) -> bool:
        """Whether tensor kernels compile with it."""
        return self.version[0] >= LLVM_MINIMUM

    def __str__(self) -> str:
        return f"LLVM {'.'.join(map(str, self.version))} ({self.path})"


def find_llvm() -> Llvm | None:
    """Return the LLVM that `DRJIT_LIBLLVM_PATH` names, else the newest that is installed.

    The result may be too old: see `Llvm.usable`. None where nothing can be loaded.
    """
    chosen = os.environ.get(_LLVM_PATH)
    return _load_llvm(chosen) if chosen else _newest_installed()


def llvm_problem() -> UserError | None:
    """Return why LLVM cannot be used, with the remedy, or None where a good one was found."""
    llvm = find_llvm()
    if llvm is not None and llvm.usable:
        return None
    chosen = os.environ.get(_LLVM_PATH)
    if llvm is not None:
        what = f"{llvm} is too old: unbake needs {LLVM_MINIMUM} or newer"
    elif not chosen:
        what = "no LLVM shared library was found"
    elif "/" in chosen and not Path(chosen).exists():
        what = f"there is no file {chosen}"
    else:
        what = f"{chosen} cannot be loaded as an LLVM shared library"
    if not chosen:
        return UserError(what, remedy=_LLVM_REMEDY)
    other = _newest_installed()
    installed = other is not None and other.usable
    remedy = f"Unset the variable: {other} is installed" if installed else _LLVM_REMEDY
    return UserError(what, where=_LLVM_PATH, remedy=remedy)


def prepare_llvm() -> None:
    """Point Dr.Jit at the LLVM of `find_llvm`, where there is a usable one; never raises.

    Has an effect only before Dr.Jit is first imported in the process.
    """
    if "drjit" in sys.modules:
        return
    llvm = find_llvm()
    if llvm is not None and llvm.usable:
        os.environ[_LLVM_PATH] = llvm.path


def cuda_driver() -> bool:
    """Whether an NVIDIA driver library can be loaded; says nothing about a device."""
    name = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
    return _load(os.environ.get("DRJIT_LIBCUDA_PATH") or name) is not None


def optix() -> bool:
    """Whether the driver brings OptiX, without which Mitsuba traces no rays on a GPU.

    Containers that are given the driver's compute part alone have CUDA and no OptiX.
    """
    name = "nvoptix.dll" if sys.platform == "win32" else "libnvoptix.so.1"
    library = _load(os.environ.get("DRJIT_LIBOPTIX_PATH") or name)
    # WSL 2 ships a loader of the same name that is no OptiX.
    return library is not None and hasattr(library, "optixQueryFunctionTable")


def activate(variant: str | None = None) -> str:
    """Choose LLVM, set the Mitsuba variant and return its name; calling it again is free.

    Args:
        variant: `cuda_ad_rgb` or `llvm_ad_rgb`. None keeps the one that is set already; where none
            is, `UNBAKE_VARIANT` decides, else CUDA where a device with OptiX answers, else LLVM.

    Raises UserError where the variant is unknown or cannot run on this machine, with the remedy.
    """
    wanted = _wanted(variant)
    if wanted != LLVM_VARIANT and "drjit" not in sys.modules:
        _take_a_gpu()
    gpu_possible = wanted != LLVM_VARIANT and cuda_driver() and optix()
    if wanted == CUDA_VARIANT and not gpu_possible:
        raise _no_cuda()
    if not gpu_possible and "drjit" not in sys.modules:
        # Told before Dr.Jit is imported: it would print complaints of its own first.
        _raise_if(llvm_problem())
    prepare_llvm()
    _require_working_folder()

    import mitsuba as mi

    _forget_working_folder()
    gpu = gpu_possible and _has_cuda()
    if wanted == CUDA_VARIANT and not gpu:
        raise _no_cuda()
    wanted = wanted or (CUDA_VARIANT if gpu else LLVM_VARIANT)
    if wanted == LLVM_VARIANT:
        _check_loaded_llvm()
    if mi.variant() != wanted:
        mi.set_variant(wanted)
    _keep_two_threads()
    return wanted


def _take_a_gpu() -> None:
    """Let one of several processes of this machine see one of its GPUs, in turn.

    Where Slurm or the user left each process one, as `CUDA_VISIBLE_DEVICES` tells, that is it.
    """
    number = next((os.environ[name] for name in LOCAL_RANKS if name in os.environ), "")
    chosen = os.environ.get(_VISIBLE)
    if not number.isdecimal():
        return
    gpus = (
        [str(i) for i in range(len(list(GPUS.glob("*"))))] if chosen is None else chosen.split(",")
    )
    if len(gpus) > 1:
        os.environ[_VISIBLE] = gpus[int(number) % len(gpus)]


def _require_working_folder() -> None:
    """Refuse a working folder that was deleted: it ends the import of Mitsuba 3.9 by SIGABRT."""
    try:
        os.getcwd()
    except OSError as error:
        what = f"the working folder cannot be used ({error.strerror})"
        raise UserError(what, remedy="Change to another folder") from None


def _forget_working_folder() -> None:
    """Let Mitsuba search its own folder alone.

    Mitsuba 3.9 searches the folder it was imported in first, also for its plugins: it would run the
    code of a `plugins/path.so` that lies there.
    """
    import mitsuba as mi

    resolver = mi.file_resolver()
    resolver.clear()
    resolver.append(str(mitsuba_folder()))


def mitsuba_folder() -> Path:
    """The folder of Mitsuba's package, in which its plugins lie."""
    import mitsuba as mi

    return Path(mi.__file__).resolve().parent


def _keep_two_threads() -> None:
    """Give Dr.Jit two threads also on one core: Mitsuba's OpenEXR waits forever for the second."""
    import drjit as dr

    if dr.thread_count() < 2:
        dr.set_thread_count(2)


def _wanted(variant: str | None) -> str | None:
    """The variant that was asked for or is set; None leaves the choice to the machine."""
    if variant is None and "mitsuba" in sys.modules:
        current = sys.modules["mitsuba"].variant()
        if current in VARIANTS:
            return current
    named = variant or os.environ.get("UNBAKE_VARIANT") or None
    if named is not None and named not in VARIANTS:
        where = None if variant else "UNBAKE_VARIANT"
        raise UserError(f"unknown variant {named!r}", where, f"Choose one of {', '.join(VARIANTS)}")
    return named


def _has_cuda() -> bool:
    import drjit as dr

    return bool(dr.has_backend(dr.JitBackend.CUDA))


def _check_loaded_llvm() -> None:
    """Raise where the LLVM that Dr.Jit did load, maybe before we could choose, is unusable."""
    import drjit as dr

    major = dr.detail.llvm_version()[0]
    if major >= LLVM_MINIMUM:
        return
    _raise_if(llvm_problem())
    found = "no LLVM" if major < 0 else f"LLVM {major}"
    raise UserError(
        f"Dr.Jit was imported before unbake could choose, and has loaded {found}",
        remedy="Call unbake.backend.activate() before importing drjit or mitsuba",
    )


def _no_cuda() -> UserError:
    if not cuda_driver():
        what, remedy = "no NVIDIA driver was found", "Install the driver"
    elif not optix():
        what = "the NVIDIA driver here comes without OptiX"
        remedy = "In a container, set NVIDIA_DRIVER_CAPABILITIES=all"
    else:
        what, remedy = "no usable CUDA device was found", "Check nvidia-smi"
    return UserError(f"{CUDA_VARIANT}: {what}", remedy=f"{remedy}, or use {LLVM_VARIANT}")


def _raise_if(problem: UserError | None) -> None:
    if problem is not None:
        raise problem


def _load(path: str) -> ctypes.CDLL | None:
    try:
        return ctypes.CDLL(path)
    except OSError:
        return None


@cache
def _load_llvm(path: str) -> Llvm | None:
    """Load a library and ask it for its version; None where it is no LLVM."""
    library = _load(path)
    if library is None:
        return None
    if hasattr(library, "LLVMGetVersion"):
        major, minor, patch = ctypes.c_uint(), ctypes.c_uint(), ctypes.c_uint()
        library.LLVMGetVersion(*map(ctypes.byref, (major, minor, patch)))
        return Llvm(path, (major.value, minor.value, patch.value))
    # LLVM 15 and older state their version through this C++ symbol alone; Dr.Jit asks it too.
    symbol = "_ZN4llvm16LTOCodeGenerator16getVersionStringEv"
    if not hasattr(library, symbol):
        return None
    stated = getattr(library, symbol)
    stated.restype = ctypes.c_char_p
    numbers = [int(n) for n in re.findall(r"\d+", stated().decode())] + [0, 0, 0]
    return Llvm(path, (numbers[0], numbers[1], numbers[2]))


def _newest_installed() -> Llvm | None:
    """Return the newest usable LLVM of this machine, else one that is too old, else None.

    The first usable one ends the search, so that one LLVM is loaded into the process and no more:
    the one that Dr.Jit loads next anyway.
    """
    too_old = None
    for path in _installed():
        if too_old is not None and 0 < _major_in_name(path) < LLVM_MINIMUM:
            break
        llvm = _load_llvm(path)
        if llvm is not None and llvm.usable:
            return llvm
        too_old = too_old or llvm
    return too_old


def _installed() -> list[str]:
    """Return the LLVM libraries of the usual places, newest first by what their names claim."""
    found = {os.path.realpath(path) for path in _search()}
    return sorted(found, key=lambda real: (_major_in_name(real), real), reverse=True)


def _search() -> Iterator[str]:
    yield from map(str, Path(sys.prefix).glob("lib*/libLLVM*"))
    for pattern in _PLACES.get(sys.platform, ()):
        root = Path(pattern).anchor
        yield from map(str, Path(root).glob(pattern[len(root) :]))
    if sys.platform == "linux":
        yield from _linker_cache()


def _linker_cache() -> list[str]:
    """Return the LLVM libraries the dynamic linker knows, wherever they are installed."""
    for command in ("ldconfig", "/sbin/ldconfig"):
        try:
            run = subprocess.run([command, "-p"], capture_output=True, text=True, timeout=5)
        except (OSError, subprocess.TimeoutExpired):
            continue
        return re.findall(r"=> (\S*/libLLVM[^/\s]*)$", run.stdout, flags=re.MULTILINE)
    return []


def _major_in_name(path: str) -> int:
    """Return the major version a library's name or folder claims, 0 where neither does."""
    name = re.search(r"LLVM(?:-C)?(?:\.so|\.dylib)?[-.](\d+)", Path(path).name)
    folder = re.search(r"llvm[-@/]?(\d+)", str(Path(path).parent))
    match = name or folder
    return int(match[1]) if match else 0


def share_cores(processes: int, least: int = 2) -> None:
    """Compute with an equal share of this machine's cores from now on.

    Args:
        processes: of this machine that share them.
        least: number of threads; images are read with two or more (`_keep_two_threads`).
    """
    import drjit as dr

    dr.set_thread_count(max(least, usable_cores() // processes))
