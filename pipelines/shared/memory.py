"""Work in a process of its own and the most memory it has held, for the benchmarks that tell it."""

import multiprocessing
from collections.abc import Callable
from pathlib import Path
from typing import Any


def peak_bytes() -> int | None:
    """Return the largest resident size this process has had; None where there is no /proc."""
    # Not getrusage, whose maximum a child inherits from the process that started it.
    try:
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM")), None)


def peak_gib() -> float | None:
    """Return `peak_bytes` in GiB."""
    peak = peak_bytes()
    return None if peak is None else peak / 2**30


def apart(work: Callable[..., None], *arguments: Any) -> dict[str, Any]:
    """Return what a function sends from a fresh process, or {"error": ...} where the process died before it did.

    Args:
        work: Called with `arguments` and a connection, to which it sends one dictionary; a function of a module.
        arguments: What it needs; picklable.
    """
    context = multiprocessing.get_context("spawn")  # a forked child would count its parent's memory as its own
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=work, args=(*arguments, sender))
    process.start()
    sender.close()
    try:
        return receiver.recv()
    except EOFError:
        process.join()
        return {"error": f"the process ended with code {process.exitcode}"}
    finally:
        process.join()
