"""Signed distance fields to compose: solids, smooth Boolean operations, deformations and relief.

A field is a function from points (3, N) float32 to values (N,) float32, negative inside. Values are distances
or close to it, within a factor of about two near the surface, which is all that `polygonise` needs.
The operations are those collected by Quilez (2008-2020), in Hart's (1996) sense of distance bounds.
"""

from collections.abc import Callable, Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from render.shapes.geometry.noise import Waves

Field = Callable[[np.ndarray], np.ndarray]
Vector = Sequence[float] | np.ndarray


def rotation(axes: str, *degrees: float) -> np.ndarray:
    """Return the rotation matrix (3, 3) of successive turns about the fixed axes `axes`, e.g. "xz"."""
    return Rotation.from_euler(axes, degrees, degrees=True).as_matrix()


def column(vector: Vector) -> np.ndarray:
    """Return a 3-vector as a float32 column (3, 1), which broadcasts against points."""
    return np.asarray(vector, dtype=np.float32).reshape(3, 1)


def length(points: np.ndarray) -> np.ndarray:
    """Return the lengths (N,) of the columns of `points` (D, N)."""
    return np.sqrt(np.einsum("dn,dn->n", points, points))


def ball(centre: Vector, radius: float) -> Field:
    """A ball."""
    centre = column(centre)
    return lambda p: length(p - centre) - np.float32(radius)


def ellipsoid(centre: Vector, radii: Vector, frame: np.ndarray | None = None) -> Field:
    """An ellipsoid with semi-axes `radii` along the columns of `frame`; a first-order distance."""
    centre, radii = column(centre), column(radii)
    turn = None if frame is None else np.asarray(frame, dtype=np.float32).T

    def field(p: np.ndarray) -> np.ndarray:
        q = p - centre
        q = (q if turn is None else turn @ q) / radii
        outer = length(q)
        return outer * (outer - 1) / (length(q / radii) + np.float32(1e-6))

    return field


def cone(start: Vector, end: Vector, start_radius: float, end_radius: float) -> Field:
    """A segment with a radius that runs linearly between two round ends."""
    start, axis = column(start), column(np.subtract(end, start))
    squared = np.float32(max(float((axis**2).sum()), 1e-12))
    first, growth = np.float32(start_radius), np.float32(end_radius - start_radius)

    def field(p: np.ndarray) -> np.ndarray:
        q = p - start
        along = np.clip((axis.T @ q)[0] / squared, 0, 1)
        return length(q - axis * along) - (first + growth * along)

    return field


def box(centre: Vector, half: Vector, rounding: float = 0.0, frame: np.ndarray | None = None) -> Field:
    """A box of half extents `half`, its edges rounded by `rounding`."""
    centre, inner = column(centre), column(half) - np.float32(rounding)
    turn = None if frame is None else np.asarray(frame, dtype=np.float32).T

    def field(p: np.ndarray) -> np.ndarray:
        q = p - centre
        q = np.abs(q if turn is None else turn @ q) - inner
        return length(np.maximum(q, 0)) + np.minimum(q.max(axis=0), 0) - np.float32(rounding)

    return field


def cylinder(centre: Vector, radius: float, half_height: float, rounding: float = 0.0) -> Field:
    """An upright cylinder (axis y) with rounded rims."""
    centre = column(centre)

    def field(p: np.ndarray) -> np.ndarray:
        q = p - centre
        side = np.hypot(q[0], q[2]) - np.float32(radius - rounding)
        rim = np.abs(q[1]) - np.float32(half_height - rounding)
        outer = np.hypot(np.maximum(side, 0), np.maximum(rim, 0))
        return outer + np.minimum(np.maximum(side, rim), 0) - np.float32(rounding)

    return field


def torus(centre: Vector, ring: float, tube: float, frame: np.ndarray | None = None) -> Field:
    """A torus around the local y axis."""
    centre = column(centre)
    turn = None if frame is None else np.asarray(frame, dtype=np.float32).T

    def field(p: np.ndarray) -> np.ndarray:
        q = p - centre
        q = q if turn is None else turn @ q
        return np.hypot(np.hypot(q[0], q[2]) - np.float32(ring), q[1]) - np.float32(tube)

    return field


def halfspace(normal: Vector, offset: float) -> Field:
    """The points with normal . p < offset."""
    normal = column(normal).T
    return lambda p: (normal @ p)[0] - np.float32(offset)


def smooth_min(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """The minimum, blended by a parabola where the two differ by less than `width`."""
    if not width:
        return np.minimum(a, b)
    overlap = np.maximum(np.float32(width) - np.abs(a - b), 0)
    return np.minimum(a, b) - overlap * overlap * np.float32(0.25 / width)


def union(fields: Sequence[Field], width: float = 0.0) -> Field:
    """The union, with fillets of size `width`."""

    def field(p: np.ndarray) -> np.ndarray:
        value = fields[0](p)
        for other in fields[1:]:
            value = smooth_min(value, other(p), width)
        return value

    return field


def intersection(fields: Sequence[Field], width: float = 0.0) -> Field:
    """The intersection, with edges rounded by `width`."""

    def field(p: np.ndarray) -> np.ndarray:
        value = -fields[0](p)
        for other in fields[1:]:
            value = smooth_min(value, -other(p), width)
        return -value

    return field


def subtraction(solid: Field, tool: Field, width: float = 0.0) -> Field:
    """`solid` with `tool` cut out, the rim rounded by `width`."""
    return lambda p: -smooth_min(-solid(p), tool(p), width)


def invert(field: Field) -> Field:
    """The outside of a solid, or a relief with hills and hollows exchanged."""
    return lambda p: -field(p)


def bound(field: Field, centre: Vector, radius: float, margin: float = 0.15) -> Field:
    """Evaluate `field`, which lies in a ball, only within `margin` of it; beyond, the distance to the ball.

    Exact in any smooth union of width up to `margin`; what makes many small parts affordable.
    """
    shell = ball(centre, radius)

    def limited(p: np.ndarray) -> np.ndarray:
        value = shell(p)
        near = np.flatnonzero(value < margin)
        if len(near):
            value[near] = field(np.ascontiguousarray(p[:, near]))
        return value

    return limited


def place(field: Field, position: Vector, frame: np.ndarray | None = None, scale: float = 1.0) -> Field:
    """Scale `field`, turn it by `frame`, and move its origin to `position`."""
    origin, size = column(position), np.float32(scale)
    turn = np.eye(3, dtype=np.float32) if frame is None else np.asarray(frame, dtype=np.float32)
    return lambda p: field((turn.T / size) @ (p - origin)) * size


def squeeze(field: Field, factors: Vector) -> Field:
    """Scale `field` along the axes by `factors`; the distance is scaled by the smallest."""
    factors = column(factors)
    return lambda p: field(p / factors) * factors.min()


def twist(field: Field, rate: float) -> Field:
    """Twist about the y axis by `rate` radians per unit height."""

    def field_of(p: np.ndarray) -> np.ndarray:
        angle = p[1] * np.float32(rate)
        sine, cosine = np.sin(angle), np.cos(angle)
        return field(np.stack([cosine * p[0] - sine * p[2], p[1], sine * p[0] + cosine * p[2]]))

    return field_of


def bend(field: Field, amount: float, heading: float = 0.0) -> Field:
    """Bow the y axis into a parabola, x and z shifted by `amount` times height squared towards `heading`."""
    shift = column([amount * np.cos(heading), 0, amount * np.sin(heading)])
    return lambda p: field(p - shift * (p[1] * p[1]))


def warp(field: Field, waves: Waves, amount: float) -> Field:
    """Displace space itself by `amount` times a vector field."""
    return lambda p: field(p + np.float32(amount) * waves(p))


def displace(field: Field, relief: Field, amount: float) -> Field:
    """Raise the surface by `amount` times `relief`; evaluated only near the surface, where it can matter."""
    reach = np.float32(6 * abs(amount))

    def raised(p: np.ndarray) -> np.ndarray:
        value = field(p)
        near = np.flatnonzero(np.abs(value) < reach)
        if len(near):
            # Faded out towards the reach, so that the field stays continuous.
            here = value[near]
            fade = 1 - (here / reach) ** 2
            value[near] = here - np.float32(amount) * fade * relief(np.ascontiguousarray(p[:, near]))
        return value

    return raised


def furrows(waves: Waves, width: float = 0.2) -> Field:
    """Rounded lobes between narrow furrows, |n| of a noise n, of about zero mean; `width` rounds the furrows."""
    rounding = np.float32(width)

    def relief(p: np.ndarray) -> np.ndarray:
        value = waves(p)
        return np.sqrt(value * value + rounding * rounding) - np.float32(0.8)

    return relief


def cracks(waves: Waves, width: float = 0.15) -> Field:
    """Flat ground (0) with narrow cracks (-1) along the zero lines of a noise."""
    return lambda p: -np.exp(-((waves(p) / np.float32(width)) ** 2))
