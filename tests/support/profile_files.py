"""ICC profiles of three primaries and one curve, with no more than decoders need."""

import struct

SPACES = {
    "sRGB": (0.43604, 0.22249, 0.01392, 0.38512, 0.71690, 0.09706, 0.14305, 0.06061, 0.71391),
    "Display P3": (0.51512, 0.24120, -0.00105, 0.29198, 0.69225, 0.04189, 0.15710, 0.06657, 0.78407),
    "Adobe RGB": (0.60974, 0.31111, 0.01947, 0.20528, 0.62567, 0.06087, 0.14919, 0.06322, 0.74457),
}


def para(*values: float) -> bytes:
    """Return a parametric curve: g; g a b; g a b c; g a b c d; or g a b c d e f."""
    form = {1: 0, 3: 1, 4: 2, 5: 3, 7: 4}[len(values)]
    return struct.pack(f">4sIHH{len(values)}i", b"para", 0, form, 0, *(round(65536 * value) for value in values))


def curv(*values: int) -> bytes:
    """Return a table of values up to 65535, one exponent times 256, or nothing: linear."""
    return struct.pack(f">4sII{len(values)}H", b"curv", 0, len(values), *values)


SRGB = para(2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)


def icc(curve: bytes, space: str = "sRGB") -> bytes:
    """Return a profile of a colour space with one curve for all channels."""
    numbers = SPACES[space]
    tags = [(name, struct.pack(">4sI3i", b"XYZ ", 0, *(round(65536 * value) for value in numbers[3 * k : 3 * k + 3])))
            for k, name in enumerate((b"rXYZ", b"gXYZ", b"bXYZ"))]  # fmt: skip
    tags += [(name, curve + bytes(-len(curve) % 4)) for name in (b"rTRC", b"gTRC", b"bTRC")]
    place, table, body = 132 + 12 * len(tags), b"", b""
    for name, data in tags:
        table += struct.pack(">4sII", name, place + len(body), len(data))
        body += data
    head = bytearray(128)
    head[12:24], head[36:40] = b"mntrRGB XYZ ", b"acsp"
    whole = bytes(head) + struct.pack(">I", len(tags)) + table + body
    return struct.pack(">I", len(whole)) + whole[4:]
