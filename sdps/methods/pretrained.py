"""Where trained weights lie: in the folder of the runs that made them, or shipped with the package."""

import math
from collections.abc import Iterable
from functools import partial
from glob import escape
from importlib import resources
from pathlib import Path

from safetensors import safe_open

from render.shared.errors import InputError, unknown
from sdps.classical.registry import METHODS
from sdps.models.registry import COMBINATIONS, MODELS

MODELS_FOLDER = "models"
SHIPPED = "shipped:"
"""Prefix of names that mean the weights shipped with the package, in spite of any trained since."""

ALL = ("all",)
"""Where names of pretrained ways are asked for: every one."""
TERMS = "research use: weights trained on materials fitted to MERL data, LICENSE-DATA"
"""Terms of the weights shipped with the package."""
_SUFFIX = ".safetensors"


def shipped_folder() -> Path:
    """Return the folder of the weights that travel with the package; it may be empty."""
    return Path(str(resources.files("assets"))) / "weights"


def list_shipped() -> list[str]:
    """Return the names of the shipped weights."""
    return sorted(path.stem for path in shipped_folder().glob(f"[!.]*{_SUFFIX}"))  # no file being written


def count_shipped(name: str) -> int | None:
    """Return how many numbers the shipped weights of a model have; None where there are none.

    Options may make a network larger than the model's own defaults (`ModelEntry.parameters`).
    """
    if name not in list_shipped():
        return None
    with safe_open(locate(name), "numpy") as weights:
        return sum(math.prod(weights.get_slice(key).get_shape()) for key in weights.keys())  # noqa: SIM118


def terms(files: Iterable[Path]) -> str:
    """Return the terms of use of weights files, as far as shipped ones are among them; else empty."""
    folder = shipped_folder().resolve()
    return TERMS if any(file.resolve().parent == folder for file in files) else ""


def list_trained(out: Path | None) -> list[str]:
    """Return the names of the runs whose last weights lie in a folder; none where it is None."""
    files = sorted((out / MODELS_FOLDER).glob(f"*/[!.]*{_SUFFIX}")) if out is not None else []
    return [path.stem for path in files if not path.stem.endswith("-best")]


def is_run(name: str) -> bool:
    """Return whether a name is a run's: not one of shipped weights, nor a file."""
    return not name.startswith(SHIPPED) and not name.endswith(_SUFFIX)


def trained_file(out: Path, name: str) -> Path:
    """Return where the weights of a run lie, or would lie, in the folder of the runs."""
    own = out / MODELS_FOLDER / name / f"{name}{_SUFFIX}"
    others = sorted((out / MODELS_FOLDER).glob(f"*/{escape(name)}{_SUFFIX}"))  # one run may make several
    return own if own.is_file() or not others else others[0]


def locate(name: str, out: Path | None = None) -> Path:
    """Return the file a name stands for, whether it is there or not.

    Args:
        name: A path that ends in `.safetensors`, `shipped:<name>`, or a run's name: its weights in `out` if they are
            there, else the shipped ones if they are.
        out: Folder of the runs; None for shipped weights only.
    """
    if name.endswith(_SUFFIX):
        return Path(name)
    kept = shipped_folder() / f"{name.removeprefix(SHIPPED)}{_SUFFIX}"
    if name.startswith(SHIPPED) or out is None:
        return kept
    own = trained_file(out, name)
    return own if own.is_file() or not kept.is_file() else kept


def require(name: str, out: Path | None = None) -> Path:
    """Return the file a name stands for.

    Raises:
        InputError: an unknown name, or weights that are not there, with what to do.
    """
    path = locate(name, out)
    if path.is_file():
        return path
    if name.endswith(_SUFFIX):
        raise InputError(f"{path}: no such weights; correct the path, or name a run or `{SHIPPED}<name>`")
    plain = name.removeprefix(SHIPPED)
    if plain not in MODELS:
        raise unknown("model or method", plain, {*list_trained(out), *list_shipped(), *MODELS, *COMBINATIONS, *METHODS})
    raise InputError(f"{path}: no such weights; train them with `sdps train --models {plain}`")


def finder(out: str | Path | None) -> "partial[Path]":
    """Return what gives the weights file of a name: trained in `out`, else shipped; it raises InputError."""
    return partial(require, out=None if out is None else Path(out))
