"""In place of the worker of `sdps app`: a process that loads nothing and runs small tasks at once."""

import math
import os
import time
from multiprocessing.connection import Connection
from typing import Any


def serve(pipe: Connection) -> None:
    """Run tasks until the other end of the pipe closes: `sleep`, `number`, `echo`, `die`."""
    while True:
        try:
            name, arguments = pipe.recv()
        except (EOFError, OSError):
            return
        result: Any = arguments
        if name == "sleep":
            pipe.send(("stage", "sleeping", 0.1))
            time.sleep(arguments["seconds"])
        elif name == "number":
            result = {"a": math.nan, "b": [math.inf, 1.5], "c": (2, "x")}
        elif name == "die":
            os._exit(9)
        pipe.send(("done", result, 1))
