"""Progress bars with ETA: live on a terminal, a line now and then in a log."""

import sys
from typing import Any

from tqdm import tqdm


def progress_bar(*args: Any, **options: Any) -> "tqdm[Any]":
    """Return a tqdm bar; where standard error is no terminal it prints a line every 20 seconds instead."""
    if not sys.stderr.isatty():
        options = {"mininterval": 20.0, "maxinterval": 20.0, "ncols": 100, "ascii": True} | options
    return tqdm(*args, **options)
