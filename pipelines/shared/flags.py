"""Flags that commands share: one per field of a configuration with its documentation as help, and back."""

import argparse
import inspect
import re
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar, get_origin

from render.records.mirror import CACHE_GB
from render.shared.errors import unknown

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T", bound="DataclassInstance")


def add_cache_argument(parser: argparse.ArgumentParser) -> None:
    """Declare how much of data in object storage is kept on this disk."""
    parser.add_argument("--cache-gb", type=float, default=CACHE_GB, metavar="GB",
                        help="of data in object storage, keep this much here")  # fmt: skip


def add_fields(parser: argparse.ArgumentParser, config: type, names: Iterable[str] = ()) -> None:
    """Declare `--field-name` for the fields of a frozen dataclass, all of them unless some are named.

    What the class's docstring says of a field under `Attributes:` is the help. Words of a tuple are given with commas.
    """
    names = list(names)
    about = dict(re.findall(r"^    (\w+): (.*(?:\n {8}.*)*)", inspect.getdoc(config) or "", re.MULTILINE))
    for entry in fields(config):
        if names and entry.name not in names:
            continue
        text = " ".join(about[entry.name].split()).rstrip(".").replace("%", "%%")
        parser.add_argument(
            f"--{entry.name.replace('_', '-')}",
            type=_words if get_origin(entry.type) is tuple else entry.type,
            default=entry.default,
            help=f"{text[0].lower()}{text[1:]}",
        )


def _words(text: str) -> tuple[str, ...]:
    return tuple(split_list([text]))


def from_flags(config: type[T], args: argparse.Namespace, **others: object) -> T:
    """Return the configuration that flags of its fields' names describe; `others` go before them.

    Raises:
        InputError: a value the class refuses.
    """
    given = {entry.name: getattr(args, entry.name) for entry in fields(config) if hasattr(args, entry.name)}
    return config(**given | others)


def add_out(parser: argparse.ArgumentParser, default: str | Path) -> None:
    """Declare `--out`."""
    parser.add_argument("--out", type=Path, default=default, help="output folder")


def add_models(parser: argparse.ArgumentParser) -> None:
    """Declare `--models`, a folder of trained runs."""
    parser.add_argument("--models", type=Path, default=None, help="folder of trained runs (default: shipped weights)")


def split_list(values: list[str] | None) -> list[str]:
    """Flatten a flag that may be repeated and may hold commas."""
    return [item.strip() for value in values or [] for item in value.split(",") if item.strip()]


def pick_names(kind: str, values: list[str] | None, known: Iterable[str]) -> list[str]:
    """Return the names of a flag that takes a list, or all that are known.

    Raises:
        InputError: an unknown name, with the nearest.
    """
    known = list(known)
    names = split_list(values) or known
    for name in names:
        if name not in known:
            raise unknown(kind, name, known)
    return names
