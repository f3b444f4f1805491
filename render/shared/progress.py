"""Progress: bars with ETA, live on a terminal, a line now and then in a log; and shares of stages for who listens."""

import itertools
import re
import sys
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from tqdm import tqdm

Listener = Callable[[str, float], None]
"""Called with the name of a stage and the share of it that is done, in [0, 1]."""
_listener: Listener | None = None
_place = (0.0, 1.0)
"""Which part of its stage what runs now is: from where on, and how much of it."""
_SHORT = 10.0
"""Seconds after which a stage has a bar."""
_QUIET = 60.0
"""Seconds between the lines of a bar in a log."""
_MOVES = re.compile(r"\r|\x1b\[[0-9;]*[A-Za-z]")


class _Lines:
    """A stream for bars in a log: each state is a line of its own, without carriage returns and terminal codes."""

    def write(self, text: str) -> int:
        """Write what is left of a bar without the moves of the cursor."""
        shown = _MOVES.sub("", text).strip()
        if shown:
            sys.stderr.write(f"{shown}\n")
        return len(text)

    def flush(self) -> None:
        """Pass on what was written."""
        sys.stderr.flush()


def progress_bar(*args: Any, **options: Any) -> "tqdm[Any]":
    """Return a tqdm bar; where standard error is not a terminal it prints a line a minute, and one when it is done."""
    if not sys.stderr.isatty():
        quiet = {"mininterval": _QUIET, "maxinterval": _QUIET, "ncols": 100, "ascii": True, "delay": _SHORT}
        options = quiet | options | {"file": _Lines()}
    return tqdm(*args, **options)


@contextmanager
def report_to(listener: Listener) -> Iterator[None]:
    """Report to `listener` the stages that `stage` names inside; in one thread at a time."""
    global _listener
    before, _listener = _listener, listener
    try:
        yield
    finally:
        _listener = before


@contextmanager
def share(start: float, stop: float) -> Iterator[None]:
    """Take the stages inside for a part of a stage, from `start` to `stop` of it, in [0, 1]; parts may be nested."""
    global _place
    before = _place
    _place = (before[0] + before[1] * start, before[1] * (stop - start))
    try:
        yield
    finally:
        _place = before


@contextmanager
def repeat(number: int, count: int) -> Iterator[None]:
    """Take the stages inside for repeat `number` of `count`, so that progress goes on instead of starting again."""
    with share(number / count, (number + 1) / count):
        yield


@contextmanager
def retell(name: str, new: str) -> Iterator[None]:
    """Report a stage inside under a new name, and no others."""
    outer = _listener
    if outer is None:
        yield
        return

    def report(own: str, done: float) -> None:
        if own == name:
            outer(new, done)

    with report_to(report):
        yield


def stage(name: str, done: float = 0, total: float = 1) -> None:
    """Say that `done` of `total` steps of a stage are done; costs nothing where nobody listens."""
    if _listener is not None:
        start, part = _place
        _listener(name, start + part * done / total)


@contextmanager
def bars(without: Collection[str] = ()) -> Iterator[None]:
    """Show a bar with the time left for every stage that takes over ten seconds.

    Args:
        without: Stages that have bars of their own.
    """
    shown: dict[str, tqdm[Any]] = {}

    def report(name: str, done: float) -> None:
        if name in without:
            return
        if name not in shown:
            _close(shown)
            look = {"bar_format": "{desc}: {percentage:3.0f}%|{bar}| {elapsed}, {remaining} left", "smoothing": 0.1}
            shown[name] = progress_bar(total=1.0, desc=name, delay=_SHORT, **look)
        shown[name].update(max(done - shown[name].n, 0.0))

    try:
        with report_to(report):
            yield
    finally:
        _close(shown)


def _close(shown: "dict[str, tqdm[Any]]") -> None:
    for bar in shown.values():
        bar.close()
    shown.clear()


@contextmanager
def share_out(weights: Mapping[str, float]) -> Iterator[None]:
    """Report the share of a whole job: its stages in order, each with its part of the time; no others."""
    outer, total = _listener, sum(weights.values())
    if outer is None:
        yield
        return
    starts = dict(zip(weights, itertools.accumulate(weights.values(), initial=0.0), strict=False))

    def report(name: str, share: float) -> None:
        if name in weights:
            outer(name, (starts[name] + weights[name] * share) / total)

    with report_to(report):
        yield
