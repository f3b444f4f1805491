"""Seeded mutations of files: of bytes, of numbers and words in text, of values in JSON and YAML, of sealed containers.

Containers that carry checksums (PNG, shards, zip archives of checkpoints) are sealed again half of the time, or nothing
behind the checksum would ever be reached.
"""

import io
import json
import random
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import Any

import yaml

from render.records import shards

LARGEST = 1 << 20
HOSTILE: list[Any] = [
    None, True, "", "nan", "-1", "../../x", "/etc/passwd", "a\nb", "\x1b[31m", "\0", "é\ud800", "x" * 5000, "<script>",
    0, -1, 1, 2**31, 2**63, -(2**63), 10**400, 1e308, -1e308, 5e-324, float("nan"), float("inf"), float("-inf"),
    [], {}, [[]], [None], [[1, 2], [3]], {"a": {"b": []}}, [0] * 1000, "2001-99-99", "1e999",
]  # fmt: skip
_WORDS = [
    b"nan", b"inf", b"-1", b"0", b"1e400", b"99999999999999999999", b"-0.0", b"\0", b"\xff\xfe", b"[" * 3000, b"{",
    b"&a [*a]", b"!!python/object/apply:os.system [id]", b"!!bool x", b"!!timestamp 2001-99-99", b"<<: *x", b"\n\n",
    b"1" * 5000, b"\xed\xa0\x80", b"---", b"? ", b"%n%s", b"../..",
]  # fmt: skip
_INTEGERS = [0, 1, 255, 2**15, 2**16 - 1, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63, 2**64 - 1]
_NUMBER = re.compile(rb"-?[0-9]+(\.[0-9]+)?([eE][-+]?[0-9]+)?")


def mutated(data: bytes, name: str, rng: random.Random) -> bytes:
    """Return another content of the file `name`, at most 1 MiB longer than before."""
    suffix = name.lower().rpartition(".")[2]
    ways: list[Callable[[bytes, random.Random], bytes]] = [_bytes]
    if suffix in ("json", "jsonl", "yaml", "yml", "gltf", "http", "relight", "dome"):
        ways += [_words, _values_of(suffix), _values_of(suffix)]
    elif suffix in ("txt", "obj", "off", "csv", "lp") or data[:5] in (b"solid", b"ply\nf"):
        ways += [_words, _words]
    elif suffix in ("pt", "zip", "npz"):
        ways += [_zipped]
    elif suffix == "safetensors":
        ways += [_described, _described]
    elif suffix == "argv":
        ways = [_argument]
    result = rng.choice(ways)(data, rng)
    if rng.random() < 0.5:
        result = {"png": sealed_png, "exr": sealed_shard}.get(suffix, lambda same: same)(result)
    return result[: len(data) + LARGEST]


def _bytes(data: bytes, rng: random.Random) -> bytes:
    """Change some bytes, mostly near the beginning, where headers are."""
    found = bytearray(data)
    for _ in range(rng.choice([1, 1, 2, 4, 16])):
        if not found:
            return bytes(found)
        reach = rng.choice([32, 256, 2048, len(found)])
        at = rng.randrange(min(reach, len(found)))
        kind = rng.randrange(8)
        if kind == 0:
            found[at] ^= 1 << rng.randrange(8)
        elif kind == 1:
            found[at] = rng.choice([0, 1, 127, 128, 255, rng.randrange(256)])
        elif kind == 2:
            form = rng.choice(["<I", ">I", "<Q", ">Q", "<H", ">H"])
            value = rng.choice(_INTEGERS) % (1 << 8 * struct.calcsize(form))
            found[at : at + struct.calcsize(form)] = struct.pack(form, value)
        elif kind == 3:
            del found[at : at + rng.choice([1, 4, 64, 1024])]
        elif kind == 4:
            found[at:at] = found[at : at + rng.choice([1, 4, 64, 1024])]
        elif kind == 5:
            del found[rng.randrange(len(found)) :]
        elif kind == 6:
            found[at:at] = rng.choice(_WORDS)
        else:
            found[at : at + 4] = struct.pack("<f", rng.choice([float("nan"), float("inf"), -1e38, 1e38, 1e-45]))
    return bytes(found)


def _words(data: bytes, rng: random.Random) -> bytes:
    """Put hostile words in place of numbers."""
    numbers = list(_NUMBER.finditer(data[:200_000]))
    for _ in range(rng.choice([1, 2, 8])):
        if numbers:
            found = rng.choice(numbers)
            data = data[: found.start()] + rng.choice(_WORDS) + data[found.end() :]
    return data


def _values_of(suffix: str) -> Callable[[bytes, random.Random], bytes]:
    """Return a way that puts hostile values into a tree of values."""

    def change(data: bytes, rng: random.Random) -> bytes:
        text = data.decode("utf-8", "replace")
        try:
            if suffix == "jsonl":
                lines = text.splitlines()
                number = rng.randrange(len(lines))
                lines[number] = json.dumps(_grafted(json.loads(lines[number]), rng))
                return ("\n".join(lines) + "\n").encode("utf-8", "surrogatepass")
            if suffix in ("json", "gltf", "http", "relight", "dome"):
                return json.dumps(_grafted(json.loads(text), rng)).encode()
            return yaml.safe_dump(_grafted(yaml.safe_load(text), rng)).encode("utf-8", "surrogatepass")
        except (ValueError, yaml.YAMLError, IndexError):
            return _bytes(data, rng)

    return change


def _grafted(value: Any, rng: random.Random) -> Any:
    """Return the tree with one node replaced, removed, or put in twice under another name."""
    if isinstance(value, dict) and value and rng.random() < 0.85:
        key = rng.choice(list(value))
        kind = rng.randrange(12)
        if kind == 0:
            return {name: item for name, item in value.items() if name != key}
        if kind == 1:
            return value | {rng.choice(["x", "", "__class__", "a.b", "é"]): value[key]}
        return value | {key: _grafted(value[key], rng)}
    if isinstance(value, list) and value and rng.random() < 0.85:
        place = rng.randrange(len(value))
        return [*value[:place], _grafted(value[place], rng), *value[place + rng.randrange(2) :]]
    return rng.choice(HOSTILE)


def _argument(data: bytes, rng: random.Random) -> bytes:
    """Put a hostile value in place of the last word of a command line."""
    *words, last = json.loads(data)
    value = rng.choice([*HOSTILE, "/dev/null", ".", "/", f"{last},{last}", "a=b", "=", "-", "--", "[", "~", "1,2", "*"])
    text = str(value).encode("utf-8", "replace").decode().replace("\0", "")  # a shell passes no zeros
    return json.dumps([*words, text]).encode()


def _described(data: bytes, rng: random.Random) -> bytes:
    """Put a hostile value into the header of a safetensors file, or into the JSON that a text of the header holds."""
    try:
        (length,) = struct.unpack_from("<Q", data)
        header = json.loads(data[8 : 8 + length])
        told = header["__metadata__"]
        key = rng.choice(list(told))
        if rng.random() < 0.8 and told[key].startswith("{"):
            told[key] = json.dumps(_grafted(json.loads(told[key]), rng))
        else:
            header = _grafted(header, rng)
        text = json.dumps(header).encode()
    except (ValueError, KeyError, struct.error):
        return _bytes(data, rng)
    return struct.pack("<Q", len(text)) + text + data[8 + length :]


def _zipped(data: bytes, rng: random.Random) -> bytes:
    """Change one member of a zip archive, and close the archive properly."""
    packed = io.BytesIO()
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive, zipfile.ZipFile(packed, "w") as other:
            members = archive.namelist()
            pickles = [name for name in members if name.endswith(".pkl")]
            chosen = rng.choice(pickles if pickles and rng.random() < 0.7 else members)
            for name in members:
                content = archive.read(name)
                other.writestr(name, _bytes(content, rng) if name == chosen else content)
    except zipfile.BadZipFile:
        return _bytes(data, rng)
    return packed.getvalue()


def sealed_png(data: bytes) -> bytes:
    """Return a PNG whose chunks have right checksums again."""
    found, at = bytearray(data), 8
    while at + 12 <= len(found):
        end = at + 8 + struct.unpack_from(">I", found, at)[0]
        if end + 4 > len(found):
            break
        struct.pack_into(">I", found, end, zlib.crc32(found[at + 4 : end]))
        at = end + 4
    return bytes(found)


def sealed_shard(data: bytes) -> bytes:
    """Return a shard whose digest is right again; other EXR files as they are."""
    match = shards._DIGEST.search(data)
    if match is None:
        return data
    return data[: match.start(1)] + shards._digest(data, match).encode() + data[match.end(1) :]
