"""Memory: what this process can still have, and a refusal of what does not fit.

Whatever may be large asks here before it allocates: a process that runs out of memory is killed, or
crashes in native code, where nothing can be told.
"""

from __future__ import annotations

import re
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil

from .errors import UserError

#: Limit and use of a control group, such as a container: psutil 7 knows those of the machine only.
_LIMITS = (
    ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"),
    ("/sys/fs/cgroup/memory/memory.limit_in_bytes", "/sys/fs/cgroup/memory/memory.usage_in_bytes"),
)
#: Limits of a process (`ulimit -v` and `-d`), and what the kernel counts against each.
_RESOURCES = ((resource.RLIMIT_AS, "VmSize"), (resource.RLIMIT_DATA, "VmData"))
_STATUS = Path("/proc/self/status")
#: What errors say where there is no memory: of Dr.Jit, the system (for a library, for a thread).
_LACKING = (
    "out of memory",
    "Cannot allocate memory",
    "failed to map segment",
    "Resource temporarily unavailable",
)


def free_bytes() -> int | None:
    """Memory that this process can still take, within its limits; None where it is not known.

    The least of what is free on the machine, in the control group, and below the limits of the
    process on its address space and on its data.
    """
    try:
        free = psutil.virtual_memory().available
    except OSError:
        return None
    for limit, used in _LIMITS:
        try:
            taken = int(Path(used).read_text()) - _page_cache(Path(used).with_name("memory.stat"))
            free = min(free, int(Path(limit).read_text()) - max(0, taken))
        except (OSError, ValueError):  # no such group, or one without a limit
            continue
    for number, key in _RESOURCES:
        limit, _ = resource.getrlimit(number)
        if limit != resource.RLIM_INFINITY:
            free = min(free, limit - _used(key))
    return max(0, free)


def reserved_counts() -> bool:
    """Whether a limit of this process counts memory that is reserved, and not only what is used."""
    limits = (resource.getrlimit(number)[0] for number, _ in _RESOURCES)
    return any(limit != resource.RLIM_INFINITY for limit in limits)


def _page_cache(file: Path) -> int:
    """Bytes of files that a control group holds in memory; the kernel gives them back on demand.

    Args:
        file: its statistics, of either version of control groups.
    """
    try:
        rows = dict(line.split() for line in file.read_text().splitlines())
        # Version 1 tells the group alone, and with the groups in it, whose use counts here.
        prefix = "total_" if "total_inactive_file" in rows else ""
        return sum(int(rows.get(f"{prefix}{kind}_file", 0)) for kind in ("active", "inactive"))
    except (OSError, ValueError):
        return 0


def _used(key: str) -> int:
    """A number of bytes that the kernel tells of this process; 0 where it does not."""
    try:
        found = re.search(rf"^{key}:\s*(\d+) kB", _STATUS.read_text(), re.MULTILINE)
    except OSError:
        return 0
    return 1024 * int(found[1]) if found else 0


def require_memory(
    need: float | None,
    what: str,
    remedy: str | Callable[[int], str],
    where: object | None = None,
) -> None:
    """Refuse what needs more memory than there is free.

    Args:
        need: bytes; None where that is not known.
        what: it is that needs them, with the verb, such as `the photographs need`.
        remedy: what to lower; or a function that tells it from the number of bytes that are free.
        where: as in `UserError`.

    Raises:
        UserError: there is not as much; it tells both numbers.
    """
    free = free_bytes()
    if need is None or free is None or need <= free:
        return
    told = f"{what} about {size(need)} of memory, {size(free)} are free"
    raise UserError(told, where, remedy if isinstance(remedy, str) else remedy(free))


#: What is told of such an error.
NO_MEMORY = "out of memory. Lower the resolution, --batch or --spp, or the size of the fields"


def lacks_memory(error: BaseException | None) -> bool:
    """Whether an error comes from running out of memory, also in native code."""
    while error is not None:
        if isinstance(error, MemoryError) or any(said in str(error) for said in _LACKING):
            return True
        error = error.__cause__ or error.__context__
    return False


@contextmanager
def lack_told() -> Iterator[None]:
    """A block in which running out of memory is a `UserError`."""
    try:
        yield
    except (MemoryError, RuntimeError, ImportError) as error:  # Dr.Jit raises the second
        if not lacks_memory(error):
            raise
        what, _, remedy = NO_MEMORY.partition(". ")
        raise UserError(what, remedy=remedy) from None


def size(count: float) -> str:
    """A number of bytes, for people: `20 MB`, `2.5 GB`, `104 GB`."""
    if count < 1e8:
        return f"{count / 1e6:.0f} MB"
    return f"{count / 1e9:.1f} GB" if count < 1e11 else f"{count / 1e9:.0f} GB"


def largest(fits: Callable[[int], bool], most: int) -> int:
    """The largest number from 1 to `most` that fits; 0 if none does.

    Args:
        fits: whether a number fits; if one does, so does every smaller one.
    """
    low, high = 0, most
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if fits(middle) else (low, middle - 1)
    return low
