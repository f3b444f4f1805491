"""A share of the work, for processes that divide it: `--part K/N`."""

import argparse
from collections.abc import Sequence
from typing import NamedTuple, TypeVar

T = TypeVar("T")


class Part(NamedTuple):
    """Every `step`-th item, from the one numbered `first` on."""

    first: int = 0
    step: int = 1

    def take(self, items: Sequence[T]) -> Sequence[T]:
        """Return the items of this part."""
        return items[self.first :: self.step]


def add_part(parser: argparse.ArgumentParser) -> None:
    """Declare the flag."""
    parser.add_argument("--part", type=_read, default=Part(), metavar="K/N",
                        help="every N-th scene, from the K-th on, counted from 0 (default: all)")  # fmt: skip


def _read(text: str) -> Part:
    """Return the part that a text names; argparse turns the error into a line."""
    first, slash, step = text.partition("/")
    if not slash or not first.isdecimal() or not step.isdecimal() or int(first) >= int(step):
        raise argparse.ArgumentTypeError(f"must be K/N with K below N, such as 0/2, got {text!r}")
    return Part(int(first), int(step))
