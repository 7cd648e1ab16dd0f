"""A remote shell without keys or passwords, for hosts that are emulated on one machine.

    python benchmarks/remote_shell.py serve ADDRESS PORT
    python benchmarks/remote_shell.py connect PORT [-OPTIONS] ADDRESS COMMAND ...

As with SSH, a command goes on where the connection is lost. Who connected gives up when nothing
is heard for some seconds, as with `ServerAliveInterval`.
"""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading

#: Seconds of silence, between questions after that, and how many stay without an answer.
_ALIVE = {socket.TCP_KEEPIDLE: 5, socket.TCP_KEEPINTVL: 5, socket.TCP_KEEPCNT: 3}


def serve(address: str, port: int) -> None:
    """Start what is sent, one command a connection, for ever."""
    with socket.create_server((address, port)) as server:
        print("ready", flush=True)
        while True:
            connection, _ = server.accept()
            with connection, connection.makefile("r") as lines:
                command = json.loads(lines.readline())
                process = subprocess.Popen(
                    ["sh", "-c", command],
                    stdin=subprocess.DEVNULL,
                    stdout=connection,
                    stderr=connection,
                    start_new_session=True,
                )
            threading.Thread(target=process.wait, daemon=True).start()


def connect(port: int, words: list[str]) -> None:
    """Let a command run on another host, and print what it prints."""
    while words[0].startswith("-"):
        words = words[1:]
    with socket.create_connection((words[0], port)) as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        for option, value in _ALIVE.items():
            connection.setsockopt(socket.IPPROTO_TCP, option, value)
        connection.sendall(json.dumps(" ".join(words[1:])).encode() + b"\n")
        try:
            while received := connection.recv(1 << 16):
                sys.stdout.buffer.write(received)
                sys.stdout.buffer.flush()
        except OSError as error:
            sys.exit(f"{words[0]}: {error.strerror}")


if __name__ == "__main__":
    if sys.argv[1] == "serve":
        serve(sys.argv[2], int(sys.argv[3]))
    else:
        connect(int(sys.argv[2]), sys.argv[3:])
