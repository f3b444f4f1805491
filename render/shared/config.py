"""Strict configuration: plain mappings (from YAML) into frozen dataclasses, and back.

An unknown key or a value of the wrong type is an `InputError` naming the dotted field.
"""

import dataclasses
import reprlib
import types
import typing
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeVar

import yaml

from render.shared.errors import InputError, unknown
from render.shared.files import check_digits, read_text

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_SHORT = reprlib.Repr()
_SHORT.maxlevel, _SHORT.maxstring, _SHORT.maxother = 3, 200, 200
"""Spells values of files in messages; references within YAML can make a short file spell terabytes."""

_MOST_VALUES = 100_000  # in a YAML file with references
T = TypeVar("T", bound="DataclassInstance")
_BOUNDS = {
    "positive": ("be positive", lambda value: value > 0),
    "not negative": ("not be negative", lambda value: value >= 0),
    "at least 1": ("be at least 1", lambda value: value >= 1),
}


def check_fields(
    config: object, bound: Literal["positive", "not negative", "at least 1"], *names: str, section: str = ""
) -> None:
    """Refuse a configuration whose fields are out of bounds; NaN is.

    Args:
        config: What has the fields, numbers.
        bound: What they must be.
        names: The fields.
        section: Section of the preset, where the field's name alone is not enough.

    Raises:
        InputError: the first that is not, with its value.
    """
    wanted, holds = _BOUNDS[bound]
    for name in names:
        value = getattr(config, name)
        if not holds(value):
            raise InputError(f"{section}{'.' if section else ''}{name} must {wanted}, got {value}")


def read_yaml(path: str | Path) -> dict[str, Any]:
    """Read a YAML file whose top level is a mapping.

    Raises:
        InputError: missing file, YAML syntax (with its line), or another top level.
    """
    value = parse_yaml(read_text(path), str(path))
    if not isinstance(value, dict):
        raise InputError(f"{path}: expected a mapping of fields at the top level, got {type(value).__name__}")
    return value


def parse_yaml(text: str, where: str) -> Any:
    """Parse YAML of plain values; no tag of it makes an object, and no two places of it share one.

    Args:
        text: The YAML.
        where: What messages begin with: the file, or the flag.

    Raises:
        InputError: not YAML, with its line.
    """
    try:
        check_digits(text)
        value = yaml.safe_load(text)
        return _copy_aliases(value, [_MOST_VALUES]) if "&" in text else value
    # The library lets through what its conversions raise: ValueError of dates, KeyError of `!!bool maybe`, and
    # RecursionError of lists in lists.
    except Exception as error:
        mark = getattr(error, "problem_mark", None)
        line = f" line {mark.line + 1}" if mark else ""
        reason = getattr(error, "problem", None) or str(error) or type(error).__name__
        raise InputError(f"{where}:{line} is not valid YAML ({reason}); correct it there") from error


def _copy_aliases(value: Any, left: list[int]) -> Any:
    """Copy what references within YAML share, so that a change in one place is none in another; `left` counts down."""
    if not isinstance(value, dict | list | tuple):
        return value
    left[0] -= len(value)
    if left[0] < 0:
        raise ValueError(f"references within it make more than {_MOST_VALUES:,} values of it")
    try:
        if isinstance(value, dict):
            return {key: _copy_aliases(item, left) for key, item in value.items()}
        return type(value)(_copy_aliases(item, left) for item in value)
    except RecursionError:
        raise ValueError("nested too deeply, or a reference to what holds it") from None


def build(cls: type[T], values: Mapping[str, Any], where: str = "") -> T:
    """Construct the dataclass `cls` from `values`, recursing into dataclass fields.

    Args:
        cls: A dataclass type.
        values: Field names to values; lists become tuples, and numbers given as text (`1e-3` is text
            in YAML 1.1) are read as numbers.
        where: Dotted name of this section, used in messages.

    Raises:
        InputError: unknown key (with the nearest), missing key, wrong type, or the class's own check.
    """
    if not isinstance(values, Mapping):
        raise InputError(f"{where or cls.__name__}: expected a section with fields, got {values!r}")
    hints = typing.get_type_hints(cls)
    fields = {field.name: field for field in dataclasses.fields(cls) if field.init}
    arguments = {}
    for key, value in values.items():
        name = f"{where}.{key}" if where else str(key)
        if key not in fields:
            raise unknown("key", name, [f"{where}.{known}" if where else known for known in fields])
        arguments[key] = _convert(hints[key], value, name)
    missing = [
        name
        for name, field in fields.items()
        if name not in arguments
        and field.default is dataclasses.MISSING
        and field.default_factory is dataclasses.MISSING
    ]
    if missing:
        raise InputError(f"{where or cls.__name__}: missing key {missing[0]!r}")
    try:
        return cls(**arguments)
    except InputError:
        raise
    except ValueError as error:
        raise InputError(f"{where + '.' if where else ''}{error}") from error


def to_plain(value: Any) -> Any:
    """Turn a dataclass (nested) into plain dicts, lists and scalars, ready for YAML or JSON."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: to_plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: to_plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [to_plain(item) for item in value]
    return str(value) if isinstance(value, Path) else value


def to_yaml(value: Any) -> str:
    """Render a dataclass or mapping as YAML text in field order."""
    return yaml.safe_dump(to_plain(value), sort_keys=False, width=120)


def _short(value: Any) -> str:
    return value if isinstance(value, str) else _SHORT.repr(value)


def _convert(hint: Any, value: Any, name: str) -> Any:
    """Convert one value to the annotated type `hint`, or raise an InputError naming the field."""
    origin, inner = typing.get_origin(hint), typing.get_args(hint)
    if isinstance(hint, type) and dataclasses.is_dataclass(hint):
        return build(hint, value, name)
    if origin in (typing.Union, types.UnionType):
        return _convert_union(inner, value, name)
    if origin is typing.Literal:
        if value not in inner:
            raise unknown(f"value for {name}:", _short(value), [str(choice) for choice in inner])
        return value
    if origin is tuple:
        items = value if isinstance(value, list | tuple) else [value]
        kinds = inner if Ellipsis not in inner else (inner[0],) * len(items)
        if len(kinds) != len(items):
            raise InputError(f"{name}: expected {len(kinds)} values, got {_SHORT.repr(value)}")
        return tuple(_convert(kind, item, name) for kind, item in zip(kinds, items, strict=True))
    if origin is dict:
        if not isinstance(value, Mapping):
            raise InputError(f"{name}: expected a mapping, got {_SHORT.repr(value)}")
        return {str(key): _convert(inner[1], item, f"{name}.{key}") for key, item in value.items()}
    return _scalar(hint, value, name)


def _convert_union(kinds: tuple[Any, ...], value: Any, name: str) -> Any:
    """Take the first member type of a union that accepts `value`."""
    if value is None and type(None) in kinds:
        return None
    errors = []
    for kind in kinds:
        if kind is type(None):
            continue
        try:
            return _convert(kind, value, name)
        except InputError as error:
            errors.append(error)
    raise errors[0]


def _scalar(hint: Any, value: Any, name: str) -> Any:
    """Check and convert bool, int, float and str; other annotations pass unchanged."""
    if hint not in (float, int, bool, str):
        return value
    if isinstance(value, bool):
        if hint is bool:
            return value
        if hint is str:  # a name that YAML takes for a truth value, as in `lights: true`
            return str(value).lower()
    elif hint is not bool and isinstance(value, int | float | str):
        with suppress(ValueError, OverflowError):
            if hint is not int or float(value) == int(float(value)):
                return hint(float(value)) if hint is int else hint(value)
    raise InputError(f"{name}: expected {hint.__name__}, got {_SHORT.repr(value)}")
