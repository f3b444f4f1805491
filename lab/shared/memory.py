"""What work takes, in seconds and memory, and work in a process of its own, for the benchmarks that tell it."""

import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from render.backend.orphans import end_with_parent
from render.shared.errors import InputError


def measure_seconds(action: Callable[[], object]) -> float:
    """Return the seconds that an action takes."""
    start = time.perf_counter()
    action()
    return time.perf_counter() - start


def resident_bytes(entry: str = "VmRSS") -> int | None:
    """Return the resident memory of this process now, or another entry of its status; None where there is no /proc."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    except OSError:
        return None
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith(entry)), None)


def peak_bytes() -> int | None:
    """Return the largest resident size this process has had; None where there is no /proc."""
    return resident_bytes("VmHWM")  # not getrusage, whose maximum a child inherits from the process that started it


def peak_gib() -> float | None:
    """Return `peak_bytes` in GiB."""
    peak = peak_bytes()
    return None if peak is None else peak / 2**30


def apart(work: Callable[..., Any], *arguments: Any) -> Any:
    """Return what a function of a module returns in a fresh process, whose memory and compiled kernels are its own.

    Raises:
        InputError: the function's own, or the process died.
    """
    # Spawned: a forked child would count its parent's memory as its own.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=end_with_parent) as pool:
        try:
            return pool.submit(work, *arguments).result()
        except BrokenProcessPool as error:
            raise InputError("the process died before it was done; there may be too little memory") from error


def measure(work: Callable[..., dict[str, Any]], *arguments: Any) -> dict[str, Any]:
    """Return what `work` returns in a fresh process and an empty `error`, or its complaint as `error` alone."""
    try:
        return {**apart(work, *arguments), "error": ""}
    except InputError as error:
        return {"error": str(error)}
