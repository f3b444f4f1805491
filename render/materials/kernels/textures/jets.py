"""Numbers that carry their derivative by the place on the object: patterns written with them have an exact slope."""

from typing import Any

from render.backend.jit import dr, mi


class Jet:
    """N values and their gradients by the position in the object frame (forward-mode differentiation).

    Args:
        value: Float (N).
        gradient: Vector3f (N).
    """

    __slots__ = ("gradient", "value")

    def __init__(self, value: Any, gradient: Any) -> None:
        self.value, self.gradient = value, gradient

    @classmethod
    def of(cls, other: Any) -> "Jet":
        """Return a Jet as it is, and a number as a constant."""
        return other if isinstance(other, Jet) else cls(mi.Float(other), mi.Vector3f(0))

    def __add__(self, other: Any) -> "Jet":
        if isinstance(other, Jet):
            return Jet(self.value + other.value, self.gradient + other.gradient)
        return Jet(self.value + other, self.gradient)

    def __neg__(self) -> "Jet":
        return Jet(-self.value, -self.gradient)

    def __sub__(self, other: Any) -> "Jet":
        return self + (-other)

    def __rsub__(self, other: Any) -> "Jet":
        return -self + other

    def __mul__(self, other: Any) -> "Jet":
        if isinstance(other, Jet):
            return Jet(self.value * other.value, self.gradient * other.value + other.gradient * self.value)
        return Jet(self.value * other, self.gradient * other)

    __radd__, __rmul__ = __add__, __mul__

    def chain(self, value: Any, slope: Any) -> "Jet":
        """Return a function of this, by its value and its derivative."""
        return Jet(value, self.gradient * slope)


def coordinates(position: Any) -> tuple[Jet, Jet, Jet]:
    """Return x, y and z of points (Vector3f)."""
    return (
        Jet(position.x, mi.Vector3f(1, 0, 0)),
        Jet(position.y, mi.Vector3f(0, 1, 0)),
        Jet(position.z, mi.Vector3f(0, 0, 1)),
    )


def sin(jet: Jet) -> Jet:
    """Return the sine."""
    sine, cosine = dr.sincos(jet.value)
    return jet.chain(sine, cosine)


def absolute(jet: Jet, blunt: float = 0.0) -> Jet:
    """Return sqrt(x^2 + blunt^2): the absolute value, its kink rounded over a width of `blunt`."""
    value = dr.sqrt(dr.square(jet.value) + blunt * blunt)
    return jet.chain(value, jet.value / dr.maximum(value, 1e-9))


def root(jet: Jet) -> Jet:
    """Return the square root of a number above 0."""
    value = dr.sqrt(dr.maximum(jet.value, 1e-9))
    return jet.chain(value, 0.5 / value)


def exp(jet: Jet) -> Jet:
    """Return e to the power."""
    value = dr.exp(jet.value)
    return jet.chain(value, value)


def step(jet: Jet, low: Any, high: Any) -> Jet:
    """Return the smooth step 3 t^2 - 2 t^3 from 0 at `low` to 1 at `high`, which may be the smaller."""
    scale = dr.rcp(mi.Float(high) - low)
    t = dr.clip((jet.value - low) * scale, 0, 1)
    return jet.chain(t * t * (3 - 2 * t), 6 * t * (1 - t) * scale)


def larger(first: Jet, second: Jet, blunt: float = 0.0) -> Jet:
    """Return the larger of two, its edge rounded over a difference of `blunt`."""
    return (first + second + absolute(first - second, blunt)) * 0.5


def choose(mask: Any, first: Jet, second: Jet) -> Jet:
    """Select per lane."""
    return Jet(dr.select(mask, first.value, second.value), dr.select(mask, first.gradient, second.gradient))


def fraction(jet: Jet) -> tuple[Jet, Any]:
    """Return the part after the decimal point, and the whole part as Int32."""
    whole = dr.floor(jet.value)
    return Jet(jet.value - whole, jet.gradient), mi.Int32(whole)


def noise(x: Jet, y: Jet, z: Jet, seed: Any, octaves: Any) -> Jet:
    """Return gradient noise (Perlin 2002), about in [-1, 1], of octaves that halve in height as they double in number.

    Args:
        x, y, z: Coordinates, one cell of the first octave per unit.
        seed: UInt32, opaque.
        octaves: UInt32, opaque.
    """
    width = max(dr.width(x.value), dr.width(y.value), dr.width(z.value))

    def body(i: Any, scale: Any, total: Any, dx: Any, dy: Any, dz: Any) -> tuple:
        # Octaves are shifted, or all would be zero at the corners of the first one's cells.
        shift = mi.Float(i) * 17.31
        place = mi.Vector3f(x.value, y.value, z.value) * scale + shift
        value, slope = _octave(place, seed + i * mi.UInt32(0x9E3779B1))
        return i + 1, scale * 2, total + value / scale, dx + slope.x, dy + slope.y, dz + slope.z

    start = (mi.UInt32(0), mi.Float(1), *(dr.zeros(mi.Float, width) for _ in range(4)))
    _, _, value, *slopes = dr.while_loop(start, lambda i, *_: i < octaves, body)
    gradient = x.gradient * slopes[0] + y.gradient * slopes[1] + z.gradient * slopes[2]
    return Jet(value, gradient)


def hash_bits(first: Any, second: Any, seed: Any) -> Any:
    """Return 32 well mixed bits of two integers."""
    bits = mi.UInt32(first) * mi.UInt32(0x8DA6B343) ^ mi.UInt32(second) * mi.UInt32(0xD8163841) ^ seed
    bits = (bits ^ (bits >> 15)) * mi.UInt32(0x2C1B3C6D)
    bits = (bits ^ (bits >> 12)) * mi.UInt32(0x297A2D39)
    return bits ^ (bits >> 15)


def uniform(bits: Any, part: int = 0) -> Any:
    """Return a number in [0, 1) of 10 of the bits; parts 0, 1 and 2 are independent."""
    return mi.Float((bits >> (10 * part)) & 1023) * (1 / 1024)


def _octave(place: Any, seed: Any) -> tuple:
    """Return one octave of gradient noise and its gradient by `place`."""
    corner = dr.floor(place)
    inside = place - corner
    cell = mi.Vector3i(corner)
    t = inside * inside * inside * (inside * (inside * 6 - 15) + 10)
    dt = 30 * inside * inside * (inside * (inside - 2) + 1)
    value, slope = mi.Float(0), mi.Vector3f(0)
    for number in range(8):
        ends = [(number >> axis) & 1 for axis in range(3)]
        away = inside - mi.Vector3f(*ends)
        bits = hash_bits(cell.x + ends[0], hash_bits(cell.y + ends[1], cell.z + ends[2], seed), seed)
        tilt = mi.Vector3f(*(uniform(bits, part) for part in range(3))) * 2 - 1
        weights = [t[axis] if ends[axis] else 1 - t[axis] for axis in range(3)]
        rates = [dt[axis] if ends[axis] else -dt[axis] for axis in range(3)]
        height = dr.dot(tilt, away)
        weight = weights[0] * weights[1] * weights[2]
        value += weight * height
        slope += weight * tilt + height * mi.Vector3f(
            rates[0] * weights[1] * weights[2], weights[0] * rates[1] * weights[2], weights[0] * weights[1] * rates[2]
        )
    return value, slope
