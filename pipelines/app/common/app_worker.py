"""The process that runs jobs: tasks by name, arguments in, stages and a result out over a pipe."""

import ctypes
import gc
import importlib
import resource
import signal
import sys
import traceback
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from render.backend.orphans import end_with_parent
from render.shared.errors import InputError
from render.shared.progress import report_to

TASKS = {
    "example": "pipelines.app.pages.photo_tasks:render_example",
    "check": "pipelines.app.pages.photo_tasks:check",
    "infer": "pipelines.app.pages.photo_tasks:infer",
    "export": "pipelines.app.pages.run_exports:export",
    "gallery": "pipelines.app.pages.studio_tasks:render_gallery",
    "scene": "pipelines.app.pages.studio_tasks:render_scene",
    "keep": "pipelines.app.pages.studio_tasks:pack_scene",
    "preset": "pipelines.app.pages.studio_tasks:make_training_preset",
    "shard": "pipelines.app.pages.studio_tasks:prepare_shard",
}
"""Tasks by name: module and function, loaded when first used."""
_STEP = 0.004  # smallest progress that is reported


def serve(pipe: Connection) -> None:
    """Run jobs until the other end of the pipe closes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the server, which ends this process
    end_with_parent()
    _warm_up()
    while True:
        try:
            name, arguments = pipe.recv()
        except (EOFError, OSError):
            return
        answer: tuple[Any, ...]
        try:
            with report_to(_make_reporter(pipe)):
                result = load_task(name)(**arguments)
            _clean_up()
            answer = ("done", result, measure_memory())
        except InputError as error:
            answer = ("failed", str(error))
        except MemoryError:
            answer = ("failed", "there is not enough memory; try fewer or smaller pictures")
        except OSError as error:  # a name that is too long, a disk that is full
            traceback.print_exc()
            answer = ("failed", str(InputError(f"{error.strerror or error}; look whether the disk is full")))
        except Exception as error:  # a bug: traceback in the terminal, one line on the page
            traceback.print_exc()
            answer = ("failed", f"unexpected error ({type(error).__name__}); the terminal shows its traceback")
        try:
            pipe.send(answer)
        except OSError:
            return


def load_task(name: str) -> Callable[..., Any]:
    """Return the function of a task."""
    module, function = TASKS[name].split(":")
    return getattr(importlib.import_module(module), function)


def measure_memory() -> int:
    """Return the bytes this process holds now, or its peak where the system does not tell the current size."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def _clean_up() -> None:
    """Release memory that libraries cache; otherwise one large scene would occupy it for good."""
    gc.collect()
    if "drjit" in sys.modules:
        sys.modules["drjit"].flush_malloc_cache()
    with suppress(OSError, AttributeError):  # other systems do not have this call
        ctypes.CDLL(None).malloc_trim(0)


def _warm_up() -> None:
    """Load the libraries that the first job would wait for."""
    for name in ("sdps.api", "render.api"):
        importlib.import_module(name)


def _make_reporter(pipe: Connection) -> Callable[[str, float], None]:
    """Return a function that sends stages through the pipe, but not each of thousands."""
    last: list[Any] = ["", -1.0]

    def tell(name: str, share: float) -> None:
        if name != last[0] or abs(share - last[1]) >= _STEP:
            last[:] = [name, share]
            pipe.send(("stage", name, share))

    return tell
