"""Child processes that end when their parent is gone.

A parent that is killed (-9) ends nobody, and the children of a pool hold both ends of its queues: they would wait for
work for ever.
"""

import os
import signal
import threading
import time
from contextlib import suppress
from multiprocessing import parent_process
from multiprocessing.connection import wait


def end_with_parent(grace: float = 0.0) -> None:
    """Watch the parent from a thread, and end this process with it; for `initializer` of a pool, too.

    Args:
        grace: Seconds between SIGTERM, which lets what is being written be removed, and the end.
    """
    threading.Thread(target=_watch, args=(grace,), daemon=True).start()


def _watch(grace: float) -> None:
    parent = parent_process()
    if parent is None:
        return
    wait([parent.sentinel])
    if grace:
        with suppress(AttributeError, OSError):
            os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(grace)  # it may hang
    os._exit(1)
