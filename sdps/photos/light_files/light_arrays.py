"""Light files that are arrays: NumPy's .npy and .npz, MATLAB's .mat, HALCON's .tup. Nothing in them is executed.

A file may hold much else, such as the pictures: headers are read first, and only what is needed is decoded.
"""

import re
import warnings
import zipfile
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from math import prod
from pathlib import Path
from typing import IO

import numpy as np
from scipy import io as scipy_io

from render.shared.decoding import decoding
from render.shared.errors import InputError, list_names
from sdps.photos.light_files.light_table import INTENSITIES, Table, Want

_NAMED = re.compile(r"(l|s|(l|light)?_?(dirs?|directions?|vectors?)|lights?(_?(dirs?|directions?|sources?|vectors?))?"
                    r"|lights?_?pos(itions?)?|sources?)", re.IGNORECASE)  # fmt: skip
_STRENGTHS = re.compile(r"intens|strength|bright|power|gain", re.IGNORECASE)
_MOST = 1 << 20  # numbers in a table of lights
_ELEMENT = re.compile(r"[12] +([+-]?\d{1,20}(?:\.\d{1,40})?(?:e[+-]\d{1,2})?)")
_MATLAB = {"double", "single", "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64"}


@dataclass(frozen=True)
class _Entry:
    """An array of numbers that may be read: its shape without sides of 1 in front and behind, and how."""

    shape: tuple[int, ...]
    read: Callable[[], np.ndarray]


def read_npy(path: Path, count: int, want: Want) -> Table:
    """Read a .npy file.

    Raises:
        InputError: damaged, or not an array of numbers of a fitting shape.
    """
    with decoding(path, "a NumPy file", "save it again with np.save"), open(path, "rb") as handle:
        entry = _numpy_entry(handle)
        if entry is None:
            raise InputError(f"{path}: holds no numbers; save the lights with np.save as an array of L x 3 numbers")
        return _choose_array(path, {"": entry}, count, want)


def read_npz(path: Path, count: int, want: Want) -> Table:
    """Read the lights of a .npz file.

    Raises:
        InputError: damaged, or not one array of a fitting shape.
    """
    with decoding(path, "a NumPy archive", "save it again with np.savez"), zipfile.ZipFile(path) as archive:
        entries = {}
        for name in archive.namelist()[:1000]:
            if name.endswith(".npy"):
                with closing(archive.open(name)) as member:
                    found = _numpy_entry(member)
                if found is not None:
                    entries[name[:-4]] = _Entry(found.shape, partial(_member, archive, name))
        return _choose_array(path, entries, count, want)


def read_mat(path: Path, count: int, want: Want) -> Table:
    """Read the lights of MATLAB's .mat file, up to version 7.

    Raises:
        InputError: damaged, version 7.3, or not one array of a fitting shape.
    """
    with decoding(path, "a MATLAB file", "save it again as version 7"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        there = scipy_io.whosmat(path)
        numbers = [(name, shape) for name, shape, kind in there if kind in _MATLAB]
        entries = {name: _Entry(_squeeze(shape), partial(_variable, path, name)) for name, shape in numbers}
        others = [f"{name} ({kind})" for name, _, kind in there if kind not in _MATLAB]
        return _choose_array(path, entries, count, want, others)


def read_tuples(path: Path, text: str, want: Want, partner: Callable[[Path], str]) -> Table:
    """Read what HALCON's `write_tuple` writes: the number of elements, then lines `kind value`, 1 integer, 2 real.

    A tuple of slants is read with the tuple of tilts beside it, and the other way round; degrees, as HALCON's
    photometric_stereo wants them. The form is that of files people keep (Base_H_Cam.tup of We-sson/HanGao on GitHub).

    Args:
        path: The file.
        text: Its content.
        want: Directions, or intensities alone: then it is one tuple of them.
        partner: Reads the text of the other file.

    Raises:
        InputError: another form, a tuple alone, or two of different length.
    """
    values = _elements(path, text)
    if not want.lights:
        return Table(values[:, None])
    other = _other_tuple(path)
    pair = {"slant": values, "tilt": _elements(other, partner(other))}
    if "tilt" in path.name.lower():
        pair = {"slant": pair["tilt"], "tilt": values}
    if len(pair["slant"]) != len(pair["tilt"]):
        raise InputError(f"{path}: has {len(values)} numbers, {other.name} another number; write both again")
    note = f"{path.name} was read with {other.name}"
    return Table(np.stack([pair["slant"], pair["tilt"]], axis=1), columns=tuple(pair), notes=(note,))


def _other_tuple(path: Path) -> Path:
    """Return the tuple of tilts beside one of slants, or the other way round."""
    for one, other in (("slant", "tilt"), ("tilt", "slant")):
        if one in path.name.lower():
            found = re.sub(one, partial(_as_case, other), path.name, flags=re.IGNORECASE)
            beside = path.with_name(found)
            if beside.is_file():
                return beside
            raise InputError(f"{path}: needs the {other}s as well; write_tuple ({other.title()}s, '{found}') beside it")
    raise InputError(f"{path}: a tuple of HALCON's may hold anything; name the two files slants.tup and tilts.tup")


def _as_case(new: str, found: re.Match[str]) -> str:
    """Return a word in the case of another: slant, Slant or SLANT."""
    was = found.group()
    return new.upper() if was.isupper() else new.title() if was[0].isupper() else new


def _elements(path: Path, text: str) -> np.ndarray:
    """Return the numbers of a tuple, (N,) float64."""
    count, *lines = (line.strip() for line in text.rstrip().split("\n"))
    if not lines or not count.isdecimal() or count.lstrip("0") != str(len(lines)):
        raise InputError(f"{path}: not a tuple of HALCON's, whose first line counts the others; write_tuple it again")
    rows = [_ELEMENT.fullmatch(line) for line in lines]
    bad = next((number for number, row in enumerate(rows, 2) if row is None), None)
    if bad is not None:
        raise InputError(f"{path}: line {bad} is not a number as write_tuple writes it (2 3.5e+01); write it again")
    return np.array([float(row[1]) for row in rows if row], np.float64)


def _numpy_entry(handle: IO[bytes]) -> _Entry | None:
    """Read the header of an array and return how to read the rest; None where it holds no numbers."""
    version = np.lib.format.read_magic(handle)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"version {version}")
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, columns_first, kind = header(handle)
    if kind.kind not in "fiu":
        return None

    def read() -> np.ndarray:
        size = prod(shape) * kind.itemsize
        data = handle.read(size)
        if len(data) < size:
            raise ValueError("it ends too early")
        return np.frombuffer(data, kind).reshape(shape, order="F" if columns_first else "C")

    return _Entry(_squeeze(shape), read)


def _member(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    with closing(archive.open(name)) as member:
        entry = _numpy_entry(member)
        assert entry is not None  # it was numbers when the archive was listed
        return entry.read()


def _variable(path: Path, name: str) -> np.ndarray:
    return scipy_io.loadmat(path, variable_names=[name])[name]


def _squeeze(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Leave sides of 1 out, but of two sides."""
    return tuple(side for side in shape if side != 1) if len(shape) > 2 else tuple(shape)


def _choose_array(
    path: Path, entries: dict[str, _Entry], count: int, want: Want, others: Sequence[str] = ()
) -> Table:  # fmt: skip
    """Read the array that is meant."""
    small = {name: one for name, one in entries.items() if len(one.shape) in (1, 2) and prod(one.shape) <= _MOST}
    fitting = [name for name, one in small.items() if _fits(one.shape, count, want)]
    rest = [name for name in fitting if not (want.lights and _STRENGTHS.search(name))]
    named = [name for name in rest if _NAMED.fullmatch(name)]
    found = rest if len(rest) == 1 else named if want.lights else [name for name in rest if _STRENGTHS.search(name)]
    if not fitting and len(small) == 1:
        found = list(small)  # its shape is what is wrong, which is said as for a text
    if len(found) != 1:
        shapes = [f"{name} ({' x '.join(map(str, entry.shape))})" for name, entry in entries.items()]
        there = list_names([*shapes, *others]) or "nothing"
        several = f"several arrays may be lights ({list_names(found or rest)})" if rest else f"holds {there}"
        wanted = " or ".join(f"{count} x {width}" for width in want.widths)
        raise InputError(f"{path}: {several}; save one array of {wanted} numbers, named {'L' if want.lights else 'E'}")
    values = _numbers(small[found[0]])
    values = values.reshape(-1, 1) if values.ndim == 1 else values
    notes = [f"of the arrays in it, {found[0]} was taken"] if len(entries) > 1 else []
    bright = [name for name, one in small.items() if _STRENGTHS.search(name)]
    matching = [name for name in bright if _fits(small[name].shape, count, INTENSITIES)]
    if not want.lights or len(matching) != 1 or len(values) == values.size:
        return Table(values, notes=tuple(notes))
    strengths = _numbers(small[matching[0]])
    strengths = strengths.T if strengths.shape[0] != count else strengths
    notes.append(f"its intensities are {matching[0]}")
    return Table(values, notes=tuple(notes), strengths=strengths.reshape(count, -1))


def _fits(shape: tuple[int, ...], count: int, want: Want) -> bool:
    """Tell whether an array may hold one row, or one column, for each picture."""
    if len(shape) < 2:
        return 1 in want.widths and shape == (count,)
    return (shape[0] == count and shape[1] in want.widths) or (shape[1] == count and shape[0] in want.widths)


def _numbers(entry: _Entry) -> np.ndarray:
    """Read an array as float64, its sides those of the entry.

    Raises:
        ValueError: complex or not finite numbers, or another shape than its header says.
    """
    values = np.asarray(entry.read())
    if values.dtype.kind not in "fiu":
        raise ValueError("complex numbers")
    values = values.astype(np.float64).reshape(entry.shape)
    if not np.isfinite(values).all():
        raise ValueError("it holds numbers that are not finite")
    return values
