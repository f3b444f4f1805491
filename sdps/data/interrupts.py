"""Ctrl-C and termination as a polite request: finish the step, save, and end."""

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@dataclass
class StopRequest:
    """Whether a signal has asked the run to stop."""

    requested: bool = False


@contextmanager
def stop_on_signal() -> Iterator[StopRequest]:
    """Yield a request that the first SIGINT or SIGTERM sets; a second one acts as it did before.

    Outside the main thread, where Python cannot handle signals, the request is never set.
    """
    stop = StopRequest()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    previous = {kind: signal.getsignal(kind) for kind in _SIGNALS}

    def restore() -> None:
        for kind, handler in previous.items():
            signal.signal(kind, handler)

    def request(*_: object) -> None:
        stop.requested = True
        restore()

    for kind in _SIGNALS:
        signal.signal(kind, request)
    try:
        yield stop
    finally:
        restore()


def leave_signals_to_parent(_: int) -> None:
    """Set up a loader process: Ctrl-C reaches the whole process group, but the trainer ends its workers itself."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
