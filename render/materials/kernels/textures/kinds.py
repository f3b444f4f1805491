"""The patterns of procedural materials: where the regions lie, and the height of the relief with its slope.

Each kind is a function that draws its numbers from the seed and one that evaluates them at points of the object in its
unit sphere. `wood`, `marble`, `noise` and `rust` are solid; the others are laid on from three sides
(`render.materials.kernels.textures.projections`).
"""

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from render.backend.arrays import opaque, table
from render.backend.jit import dr, mi
from render.materials.kernels.textures.jets import (
    Jet,
    absolute,
    choose,
    exp,
    fraction,
    hash_bits,
    larger,
    noise,
    root,
    sin,
    step,
    uniform,
)  # fmt: skip

FLAT = ("tiles", "weave", "print", "scratches")  # patterns of two coordinates


class Layers(NamedTuple):
    """A pattern at N points.

    Attributes:
        second, third: Float (N) in [0, 1], how far the second and then the third region cover what lies below.
        tone: Float (N), factor on the base colour.
        wear: Float (N), added to the roughness.
        height: Jet (N), in radii of the object.
    """

    second: Any
    third: Any
    tone: Any
    wear: Any
    height: Jet


class Numbers:
    """Named numbers of a pattern as one array, so that another seed compiles no other kernel."""

    def __init__(self, rng: np.random.Generator, values: dict[str, Any]) -> None:
        self._places: dict[str, int] = {}
        flat: list[float] = []
        for name, value in values.items():
            self._places[name] = len(flat)
            flat += np.ravel(value).tolist()
        self._values = table(flat)
        self.seed = opaque(mi.UInt32(int(rng.integers(2**32))))

    def __getitem__(self, name: str) -> Any:
        return dr.gather(mi.Float, self._values, mi.UInt32(self._places[name]))

    def entry(self, name: str, index: Any) -> Any:
        """Return an entry of an array by its number."""
        return dr.gather(mi.Float, self._values, index + self._places[name])

    def turn(self, name: str, point: tuple) -> tuple[Jet, Jet, Jet]:
        """Return coordinates multiplied by a matrix (3, 3)."""
        first = self._places[name]
        at = [dr.gather(mi.Float, self._values, mi.UInt32(first + k)) for k in range(9)]
        rows = [point[0] * at[3 * k] + point[1] * at[3 * k + 1] + point[2] * at[3 * k + 2] for k in range(3)]
        return rows[0], rows[1], rows[2]


def _octaves(count: int) -> Any:
    return opaque(mi.UInt32(count))


def _any_turn(rng: np.random.Generator) -> np.ndarray:
    return Rotation.random(rng=rng).as_matrix()


def draw_noise(rng: np.random.Generator) -> dict[str, Any]:
    relief = rng.uniform(0.01, 0.03)
    return {"turn": _any_turn(rng) * rng.uniform(1.5, 4), "edge": rng.uniform(0.05, 0.4), "relief": relief}


def solid_noise(point: tuple, n: Numbers) -> Layers:
    x, y, z = n.turn("turn", point)
    large = noise(x, y, z, n.seed, _octaves(4))
    fine = noise(x * 5.3, y * 5.3, z * 5.3, n.seed + 7, _octaves(2))
    edge = n["edge"]
    return Layers(
        step(large, -edge, edge).value, step(fine + large * 0.6, 0.25, 0.4).value, 1 + 0.25 * fine.value,
        0.1 * fine.value, (large * 0.8 + fine) * n["relief"],
    )  # fmt: skip


def draw_marble(rng: np.random.Generator) -> dict[str, Any]:
    return {
        "turn": _any_turn(rng) * rng.uniform(0.9, 1.8), "bands": rng.uniform(1.0, 2.5), "warp": rng.uniform(1.5, 3.5),
        "width": rng.uniform(0.03, 0.12), "rare": rng.uniform(0.012, 0.03), "relief": rng.uniform(0.002, 0.006),
    }  # fmt: skip


def solid_marble(point: tuple, n: Numbers) -> Layers:
    x, y, z = n.turn("turn", point)
    cloud = noise(x, y, z, n.seed, _octaves(5))
    other = noise(x * 1.7, y * 1.7, z * 1.7, n.seed + 11, _octaves(4))
    wave = sin((x * n["bands"] + cloud * n["warp"]) * np.pi)
    vein = exp(absolute(wave, 0.01) * (-1 / n["width"]))
    line = exp(absolute(other + cloud * 0.4, 0.004) * (-1 / n["rare"]))
    veil = dr.clip(vein.value + 0.35 * step(cloud, 0.0, 0.6).value, 0, 1)
    height = (vein + line * 0.7) * (-n["relief"])
    return Layers(veil, step(line, 0.3, 0.7).value, 1 + 0.12 * other.value, 0.15 * vein.value, height)


def draw_wood(rng: np.random.Generator) -> dict[str, Any]:
    return {
        "turn": _any_turn(rng), "rings": rng.uniform(5, 11), "away": rng.uniform(0.2, 1.1),
        "wave": rng.uniform(0.1, 0.45), "relief": rng.uniform(0.003, 0.008),
    }  # fmt: skip


def solid_wood(point: tuple, n: Numbers) -> Layers:
    x, y, z = n.turn("turn", point)
    bend = noise(x * 1.3, y * 1.3, z * 0.5, n.seed, _octaves(2))
    across = x + n["away"]
    radius = root(across * across + y * y + 1e-4)
    ring = sin((radius * n["rings"] + bend * (n["wave"] * n["rings"])) * (2 * np.pi))
    late = step(ring, 0.0, 0.95)
    fibre = noise(x * 26.0, y * 26.0, z * 2.2, n.seed + 3, _octaves(2))
    pore = step(fibre, 0.28, 0.5)
    height = (late * 0.5 + fibre * 0.7 - pore * 0.6) * n["relief"]
    return Layers(
        late.value * 0.9, pore.value * 0.7, 1 + 0.18 * fibre.value + 0.15 * bend.value, 0.1 * fibre.value, height
    )


def draw_rust(rng: np.random.Generator) -> dict[str, Any]:
    return {
        "turn": _any_turn(rng) * rng.uniform(1.1, 2.4), "spread": rng.uniform(-0.05, 0.25),
        "relief": rng.uniform(0.006, 0.014),
    }  # fmt: skip


def solid_rust(point: tuple, n: Numbers) -> Layers:
    x, y, z = n.turn("turn", point)
    patch = noise(x, y, z, n.seed, _octaves(5)) + n["spread"]
    grain = noise(x * 7.1, y * 7.1, z * 7.1, n.seed + 5, _octaves(2))
    eaten = step(patch, 0.02, 0.06)
    rim = exp((patch - 0.04) * (patch - 0.04) * -2500.0)
    # Rust swells in the middle of a patch and pits; the paint around it stands on an edge.
    swollen = eaten * (step(patch, 0.04, 0.5) * 0.9 + grain * 0.9 - 0.35)
    streak = 1 - 0.25 * step(patch, -0.25, 0.0).value
    tone = dr.lerp(streak, 1 + 0.5 * grain.value + 0.6 * patch.value, eaten.value)
    return Layers(eaten.value, 0.75 * rim.value, tone, 0.05 * grain.value, swollen * n["relief"])


def draw_tiles(rng: np.random.Generator) -> dict[str, Any]:
    count, brick = rng.uniform(2.2, 5), rng.random() < 0.5
    bevel = rng.uniform(0.06, 0.14)
    return {
        "across": count / (2 if brick else 1), "down": count, "shift": 0.5 if brick else rng.choice([0.0, 0.0, 0.5]),
        "gap": rng.uniform(0.02, 0.05), "bevel": bevel, "relief": 0.35 * bevel / count,
        "checked": float(not brick and rng.random() < 0.5), "share": rng.uniform(0.1, 0.5),
        "ripple": rng.uniform(0.0, 0.25),
    }  # fmt: skip


def flat_tiles(u: Jet, v: Jet, side: int, n: Numbers) -> Layers:
    (down, row) = fraction(v * n["down"])
    (across, column) = fraction(u * n["across"] + mi.Float(row) * n["shift"])
    gap, wide = n["gap"], n["bevel"] + n["gap"]
    ratio = n["down"] / n["across"]
    edges = [absolute(along - 0.5) * -1.0 + 0.5 for along in (across, down)]
    profile = step(edges[0] * ratio, gap, wide) * step(edges[1], gap, wide)
    bits = hash_bits(column, row, n.seed + side)
    tilt = [(uniform(bits, part) - 0.5) * 0.5 for part in (0, 1)]
    ripple = noise(u * 6.0, v * 6.0, Jet.of(side * 3.7), n.seed + 1, _octaves(2))
    face = (across - 0.5) * tilt[0] + (down - 0.5) * tilt[1] + ripple * n["ripple"] + 1.0
    second = dr.select(
        n["checked"] > 0.5, mi.Float((column + row) & 1), dr.select(uniform(bits, 2) < n["share"], 1.0, 0.0)
    )
    tone = 0.85 + 0.3 * uniform(bits, 1) + 0.15 * ripple.value
    joint = 1 - step(larger(edges[0] * ratio * -1.0, edges[1] * -1.0), -gap * 1.2, -gap * 0.7).value
    return Layers(second, 1 - joint, tone, 0.1 * ripple.value, profile * face * n["relief"])


def draw_weave(rng: np.random.Generator) -> dict[str, Any]:
    threads = rng.uniform(6, 13)
    return {
        "threads": threads, "relief": 0.2 / threads, "plain": float(rng.random() < 0.45),
        "period": rng.integers(4, 9), "band": rng.integers(1, 4), "twist": rng.uniform(3, 7),
    }  # fmt: skip


def flat_weave(u: Jet, v: Jet, side: int, n: Numbers) -> Layers:
    u, v = u * n["threads"], v * n["threads"]
    (_, i), (_, j) = fraction(u), fraction(v)
    odd = [dr.select((k & 1) == 0, 1.0, -1.0) for k in (i, j)]
    up, along = sin(v * np.pi), sin(u * np.pi)
    round_u, round_v = absolute(along, 0.15), absolute(up, 0.15)
    warp = round_u * (up * odd[0] * 0.5 + 0.6)
    weft = round_v * (along * odd[1] * -0.5 + 0.6)
    top = larger(warp, weft, 0.05)
    on_top = warp.value > weft.value
    turns = n["twist"] * 2 * np.pi
    strand = choose(on_top, sin(v * turns + u * 6.0), sin(u * turns + v * 6.0))
    coloured = [mi.Float(k) - n["period"] * dr.floor(mi.Float(k) / n["period"]) < n["band"] for k in (i, j)]
    # A plain cloth has warp and weft of its two colours; a checked one has bands of either colour both ways.
    second = dr.select(n["plain"] > 0.5, ~on_top, dr.select(on_top, coloured[0], coloured[1]))
    hollow = 1 - step(top, 0.2, 0.55).value
    bits = hash_bits(dr.select(on_top, i, j), dr.select(on_top, 1, 2), n.seed)
    tone = (0.85 + 0.3 * uniform(bits)) * (0.9 + 0.12 * strand.value)
    return Layers(dr.select(second, 1.0, 0.0), hollow, tone, mi.Float(0), (top + strand * 0.04) * n["relief"])


def draw_print(rng: np.random.Generator) -> dict[str, Any]:
    count = rng.uniform(2.5, 6)
    return {
        "count": count, "petals": rng.integers(3, 9), "lobed": rng.choice([0.0, 0.15, 0.35]),
        "size": rng.uniform(0.2, 0.36), "ring": rng.uniform(0.02, 0.06), "stagger": rng.choice([0.0, 0.5]),
        "turn": rng.uniform(0, 2 * np.pi), "relief": rng.choice([-1, 1]) * rng.uniform(0.03, 0.08) / count,
        "grain": rng.uniform(0, 0.4),
    }  # fmt: skip


def flat_print(u: Jet, v: Jet, side: int, n: Numbers) -> Layers:
    (down, row) = fraction(v * n["count"])
    (across, _) = fraction(u * n["count"] + mi.Float(row) * n["stagger"])
    x, y = across - 0.5, down - 0.5
    radius = root(x * x + y * y + 1e-5)
    square = dr.maximum(dr.square(x.value) + dr.square(y.value), 1e-5)
    angle = Jet(dr.atan2(y.value, x.value), (y.gradient * x.value - x.gradient * y.value) / square)
    # Waves along the angle fade out towards the middle, where the angle turns fast.
    outline = sin(angle * n["petals"] + n["turn"]) * step(radius, 0.02, 0.12) * n["lobed"] + 1.0
    away = radius - outline * n["size"]
    ring = n["ring"]
    inside = step(away, ring * 0.3, ring * -0.3)
    middle = step(radius, n["size"] * 0.42, n["size"] * 0.36)
    grain = noise(u * 14.0, v * 14.0, Jet.of(side * 5.1), n.seed, _octaves(2))
    cushion = step(away, ring * 0.5, ring * -1.5) - middle * 0.5
    height = cushion * n["relief"] + grain * (n["grain"] * 0.008)
    border = exp(away * away * (-4.0 / (ring * ring))).value
    third = dr.clip(middle.value + border, 0, 1)
    return Layers(inside.value, third, 1 + 0.1 * grain.value, 0.08 * grain.value, height)


def draw_scratches(rng: np.random.Generator) -> dict[str, Any]:
    return {
        "turns": rng.uniform(0, np.pi, 3), "rows": rng.uniform(5, 11), "depth": rng.uniform(0.002, 0.005),
        "brushed": rng.uniform(0.0, 0.0025), "stains": rng.uniform(0.25, 0.5),
    }  # fmt: skip


def flat_scratches(u: Jet, v: Jet, side: int, n: Numbers) -> Layers:
    number = opaque(mi.UInt32(3))

    def layer(k: Any, value: Any, gradient: Any) -> tuple:
        turn = n.entry("turns", k)
        sine, cosine = dr.sincos(turn + mi.Float(k) * 1.1)
        along, across = u * cosine + v * sine, v * cosine - u * sine
        (_, lane) = fraction(along * 0.8 + mi.Float(k) * 0.37)
        middle, row = fraction(across * n["rows"])
        bits = hash_bits(row, lane + mi.Int32(k) * 71, n.seed + side)
        there = mi.Float(mi.UInt32(bits >> 30) < 2)
        # A scratch lies anywhere in its row, a little askew, and thins out towards its ends.
        place, askew = 0.25 + 0.5 * uniform(bits, 0), (uniform(bits, 1) - 0.5) * 0.4
        length, _ = fraction(along * 0.8 + mi.Float(k) * 0.37)
        fade = step(absolute(length - 0.5), 0.5, 0.1 + 0.3 * uniform(bits, 2))
        distance = (middle - place - (length - 0.5) * askew) * (1 / n["rows"])
        groove = exp(distance * distance * -9000.0) * fade * there
        return k + 1, value + groove.value, gradient + groove.gradient

    width = dr.width(u.value)
    state = (mi.UInt32(0), dr.zeros(mi.Float, width), dr.zeros(mi.Vector3f, width))
    _, value, gradient = dr.while_loop(state, lambda k, *_: k < number, layer)
    total = Jet(value, gradient)
    turn = n.entry("turns", mi.UInt32(0))
    sine, cosine = dr.sincos(turn)
    brush = noise((u * cosine + v * sine) * 1.2, (v * cosine - u * sine) * 45.0, Jet.of(side * 4.3), n.seed,
                  _octaves(2))  # fmt: skip
    stain = noise(u * 1.8, v * 1.8, Jet.of(side * 2.9), n.seed + 9, _octaves(3))
    dirt = step(stain, n["stains"], n["stains"] + 0.12).value * 0.6
    height = total * (-n["depth"]) + brush * n["brushed"]
    return Layers(
        dr.minimum(total.value, 1), dirt, 1 + 0.12 * brush.value, 0.12 * brush.value + 0.1 * stain.value, height
    )
