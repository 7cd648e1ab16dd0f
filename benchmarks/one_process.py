"""`unbake` in one process, whose fits compute as those of several processes do.

    python benchmarks/one_process.py fit DATA --out RUN

On one core a process that is alone computes with two threads, because reading images needs them.
One of several goes on with a thread a core when all is read. This does so, too, so that both can be
compared.
"""

from __future__ import annotations

import here

from unbake import backend, cli


def compute_with_a_thread_a_core() -> None:
    """Let fits of this process go on with a thread a core when all input is read."""
    from unbake.training import loop

    agree = loop.agree

    def agreed(*begun: object) -> None:
        agree(*begun)
        backend.share_cores(1, least=1)

    loop.agree = agreed


if __name__ == "__main__":
    backend.activate()
    compute_with_a_thread_a_core()
    cli.main()
