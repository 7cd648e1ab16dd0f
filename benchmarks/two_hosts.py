"""Two hosts on one machine: namespaces of Linux, joined by a virtual cable.

Each has a name, network interfaces, shared memory and semaphores of its own; files, cores and
numbers of processes are those of the machine. `mpiexec` starts processes on the second host by a
remote shell, over the same cable as the messages between them. Only root on Linux may make such
hosts; `why_not` says what is missing.
"""

from __future__ import annotations

import contextlib
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import psutil
from small_run import in_group_of_its_own, mpiexec

CABLE = "cable0"
ADDRESSES = ("10.213.77.1", "10.213.77.2")
_SHELL_PORT = 2222
_SHELL = Path(__file__).with_name("remote_shell.py")
_NAMESPACES = ("--net", "--uts", "--ipc", "--mount")
#: What the first process of a host does; interfaces are found in /sys.
_HOST = (
    "hostname {} && mount -t tmpfs tmpfs /dev/shm && mount -t sysfs sysfs /sys && "
    "ip link set lo up && echo ready && exec sleep infinity"
)


def why_not() -> str | None:
    """What keeps this process from making hosts; None: nothing."""
    missing = [name for name in ("unshare", "nsenter", "ip", "tc") if shutil.which(name) is None]
    if missing:
        return f"two hosts cannot be emulated: {', '.join(missing)} is missing"
    tried = [
        "unshare",
        *_NAMESPACES,
        "sh",
        "-c",
        "ip link add name a type veth && mount -t sysfs a /sys",
    ]
    done = subprocess.run(tried, capture_output=True, text=True)
    return f"two hosts cannot be emulated: {done.stderr.strip()}" if done.returncode else None


class TwoHosts:
    """Two hosts and the cable between them; all that runs on them ends with the block."""

    def __init__(self) -> None:
        self._held = contextlib.ExitStack()
        self._keepers: list[subprocess.Popen[str]] = []
        self._shell: subprocess.Popen[str] | None = None

    def __enter__(self) -> TwoHosts:
        with contextlib.ExitStack() as held:
            folder = Path(held.enter_context(tempfile.TemporaryDirectory()))
            held.callback(self._end_all)
            for name in ("host-1", "host-2"):
                words = ["unshare", *_NAMESPACES, "sh", "-c", _HOST.format(name)]
                self._keepers.append(_ready(words))
            peer = ("peer", "name", CABLE, "netns", str(self._keepers[1].pid))
            self._on(0, "ip", "link", "add", CABLE, "type", "veth", *peer)
            for number, address in enumerate(ADDRESSES):
                self._on(number, "ip", "address", "add", f"{address}/24", "dev", CABLE)
            self.join()
            shell, port = (sys.executable, str(_SHELL)), str(_SHELL_PORT)
            self._shell = _ready(self._words(1, *shell, "serve", ADDRESSES[1], port))
            self._launcher = folder / "launch"
            connect = shlex.join((*shell, "connect", port))
            self._launcher.write_text(f'#!/bin/sh\nexec {connect} "$@"\n')
            self._launcher.chmod(0o700)
            self._held = held.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._held.close()

    def start(self, *words: str, core_each: bool = False) -> subprocess.Popen[str]:
        """Start a command by `mpiexec` on the first host: two processes, one on each host.

        Args:
            words: of the command.
            core_each: give each process one core of its own, instead of all.
        """
        launcher = ("-launcher", "ssh", "-launcher-exec", str(self._launcher))
        hosts = ("-hosts", ",".join(ADDRESSES), "-ppn", "1")
        cores = (("taskset", "-c", str(core)) if core_each else () for core in (0, 1))
        first, second = (("-n", "1", *core, *words) for core in cores)
        words = self._words(0, mpiexec(), *launcher, *hosts, *first, ":", *second)
        return in_group_of_its_own(words)

    def shape(self, bits: float | None) -> None:
        """Limit what each host sends in a second, in bits; None: by nothing.

        Raises:
            OSError: the kernel cannot.
        """
        for number in (0, 1):
            self._on(number, "tc", "qdisc", "delete", "dev", CABLE, "root", check=False)
            if bits is not None:
                burst = max(int(bits / 8 / 1000), 1 << 16)  # a millisecond, or one large packet
                words = ("rate", f"{bits:.0f}bit", "burst", str(burst), "latency", "50ms")
                self._on(number, "tc", "qdisc", "add", "dev", CABLE, "root", "tbf", *words)

    def cut(self) -> None:
        """Pull the cable: what is sent is lost, and nobody is told."""
        self._on(0, "ip", "link", "set", CABLE, "down")

    def join(self) -> None:
        """Plug the cable in, and wait until both ends carry."""
        for number in (0, 1):
            self._on(number, "ip", "link", "set", CABLE, "up")
        for number in (0, 1):
            while self._on(number, "cat", f"/sys/class/net/{CABLE}/operstate").strip() != "up":
                time.sleep(0.01)

    def sent(self) -> tuple[int, int]:
        """Bytes that each host has sent by the cable."""
        file = f"/sys/class/net/{CABLE}/statistics/tx_bytes"
        return int(self._on(0, "cat", file)), int(self._on(1, "cat", file))

    def running(self, number: int) -> list[psutil.Process]:
        """The processes of a host, but for its first one and the remote shell's server."""
        own = {keeper.pid for keeper in (*self._keepers, self._shell) if keeper is not None}
        network, found = _network(self._keepers[number].pid), []
        for process in psutil.process_iter():
            if process.pid not in own and _network(process.pid) == network:
                found.append(process)
        return found

    def _on(self, number: int, *words: str, check: bool = True) -> str:
        """What a command of a host prints."""
        done = subprocess.run(self._words(number, *words), capture_output=True, text=True)
        if check and done.returncode:
            raise OSError(f"{shlex.join(words)}: {done.stderr.strip()}")
        return done.stdout

    def _words(self, number: int, *words: str) -> list[str]:
        target = ("--target", str(self._keepers[number].pid))
        return ["nsenter", *target, *_NAMESPACES, f"--wd={Path.cwd()}", *words]

    def _end_all(self) -> None:
        for number in range(len(self._keepers)):
            for process in self.running(number):
                with contextlib.suppress(psutil.NoSuchProcess):
                    process.kill()
        for process in (self._shell, *self._keepers):
            if process is not None:
                process.kill()
                process.communicate()


def _ready(words: list[str]) -> subprocess.Popen[str]:
    """A process that has said it is ready."""
    process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert process.stdout is not None
    if process.stdout.readline() != "ready\n":
        process.kill()
        raise OSError(process.communicate()[1].strip())
    return process


def _network(pid: int) -> str | None:
    """The network that a process sees; None where it is gone, or a dead one."""
    try:
        return os.readlink(f"/proc/{pid}/ns/net")
    except OSError:
        return None
