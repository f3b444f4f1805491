"""The one reflectance model of the project: a factored half-vector BRDF with small tables.

Every material, from Lambertian to chrome, has the same parametric form, per colour channel

    f(wi, wo) = S(theta_i) S(theta_o) T(theta_h, theta_d) exp(e A(theta_h, theta_d)),   linear in e on the knots,

with the half and difference angles of Rusinkiewicz (1998) and e = cos^2 phi_d, the only azimuthal dependence that a
reciprocal, mirror-symmetric isotropic BRDF has to first order. T is the bivariate BRDF of Romeiro et al. (2008), S the
shadowing-like factor of the non-parametric microfacet model of Bagher et al. (2016), A a coarse correction.
This module is the slow, plain numpy form; `render.materials.kernels.bsdf` evaluates the same tables in a kernel.
"""

from dataclasses import dataclass

import numpy as np

from render.shared.errors import InputError
from render.shared.imaging.vectors import unit

VERSION = 1
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])  # of linear RGB, ITU-R BT.709
HALF_KNOTS = 32
DIFFERENCE_KNOTS = 6
SHADOWING_KNOTS = 9
AZIMUTH_KNOTS = (8, 5)
_SHAPES = {
    "bivariate": (3, HALF_KNOTS, DIFFERENCE_KNOTS),
    "shadowing": (3, SHADOWING_KNOTS),
    "azimuth": (3, AZIMUTH_KNOTS[0] - 1, AZIMUTH_KNOTS[1] - 1),
}


@dataclass(frozen=True, kw_only=True, eq=False)
class Material:
    """A reciprocal, isotropic BRDF in linear RGB; arrays are float64 and read-only.

    Attributes:
        name: Library name, e.g. `chrome`.
        category: Family, e.g. `metal`, `fabric`.
        fit_error: Relative RMS error of a rendered sphere against the data the material was fitted to (0: exact).
        source: Where the data come from.
        terms: Terms of use of the data.
        model: Version of this model, must equal `VERSION`.
        bivariate: (3, 32, 6) T in 1/sr over the knots of `half_coordinate` and `difference_coordinate`.
        shadowing: (3, 9) S over 1 - cos(theta), uniform from the normal to the horizon; S(normal) is 1 by convention.
        azimuth: (3, 7, 4) A, the natural logarithm of f(e = 1) / f(e = 0), without the first row and column, which
            are zero because phi_d is undefined where theta_h or theta_d vanishes.

    Raises:
        InputError: a table of the wrong shape, a value that is not finite or is negative, another model version.
    """

    name: str
    category: str
    bivariate: np.ndarray
    shadowing: np.ndarray
    azimuth: np.ndarray
    fit_error: float = 0.0
    source: str = ""
    terms: str = ""
    model: int = VERSION

    def __post_init__(self) -> None:
        if self.model != VERSION:
            raise InputError(f"model: version {self.model} is not {VERSION}; fit the material again")
        if not 0 <= self.fit_error < np.inf:
            raise InputError(f"fit_error: must be a finite number >= 0, got {self.fit_error}")
        for field, shape in _SHAPES.items():
            object.__setattr__(self, field, _table(field, getattr(self, field), shape))
        for field in ("bivariate", "shadowing"):
            if (getattr(self, field) < 0).any():
                raise InputError(f"{field}: values must be >= 0, got {getattr(self, field).min():g}")
        if np.abs(self.azimuth).max() > 10:
            raise InputError(f"azimuth: log ratios must lie in [-10, 10], got {np.abs(self.azimuth).max():g}")


def _table(field: str, values: object, shape: tuple[int, ...]) -> np.ndarray:
    """Convert to a read-only float64 array of `shape` or raise an InputError naming `field`."""
    try:
        table = np.array(values, np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{field}: expected numbers in a {_product(shape)} table ({error})") from error
    if table.shape != shape:
        raise InputError(f"{field}: expected a {_product(shape)} table, got {_product(table.shape)}")
    if not np.isfinite(table).all():
        raise InputError(f"{field}: every value must be finite")
    table.flags.writeable = False
    return table


def _product(shape: tuple[int, ...]) -> str:
    return "x".join(map(str, shape)) or "single value"


def lambertian(albedo: float | tuple[float, float, float]) -> Material:
    """Return the Lambertian material f = albedo / pi.

    Args:
        albedo: One value or linear RGB, each in (0, 1].

    Raises:
        InputError: an albedo outside (0, 1].
    """
    rgb = np.broadcast_to(np.asarray(albedo, np.float64), 3)
    if not ((rgb > 0) & (rgb <= 1)).all():
        raise InputError(f"lambertian: albedo must lie in (0, 1], got {albedo}")
    text = "/".join(f"{value:g}" for value in (rgb[:1] if np.ptp(rgb) == 0 else rgb))
    return Material(
        name=f"lambertian:{text}",
        category="lambertian",
        source="analytic",
        bivariate=np.broadcast_to(rgb[:, None, None] / np.pi, _SHAPES["bivariate"]),
        shadowing=np.ones(_SHAPES["shadowing"]),
        azimuth=np.zeros(_SHAPES["azimuth"]),
    )


def half_coordinate(one_minus_cos: np.ndarray) -> np.ndarray:
    """Map 1 - cos(theta_h) to [0, 1]: x = 2 r / (1 + r), r = (1 - cos)^(1/4) ~ sqrt(theta_h) / 2^(1/4).

    Like the square-root spacing of the MERL tables, denser still near zero: the second of 32 knots is at 0.02 degrees.
    """
    root = np.sqrt(np.sqrt(one_minus_cos))
    return 2 * root / (1 + root)


def half_knots() -> np.ndarray:
    """Return 1 - cos(theta_h) at the knots, the inverse of `half_coordinate`; (32,) from 0 to 1."""
    x = np.linspace(0, 1, HALF_KNOTS)
    return (x / (2 - x)) ** 4


def difference_coordinate(cos_d: np.ndarray) -> np.ndarray:
    """Map cos(theta_d) to [0, 1]: sqrt(1 - cos(theta_d)), nearly linear in the angle."""
    return np.sqrt(np.clip(1 - cos_d, 0, 1))


def coordinates(wi: np.ndarray, wo: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the table coordinates of theta_h and theta_d, and e = cos^2(phi_d), each (N,) in [0, 1].

    1 - cos(theta_h) is taken from the tangential length of the half vector as sin^2 / (1 + cos): the difference itself
    would lose the sub-degree peaks of mirror-like metals in float32. e follows from the projections of wi and wo,
    cos_o - cos_i = 2 sin(theta_h) sin(theta_d) cos(phi_d), without any angle.
    """
    half = unit(wi + wo)  # (N, 3)
    sin2_h = half[:, 0] ** 2 + half[:, 1] ** 2
    cos_d = np.minimum((wi * half).sum(1), 1)
    product = sin2_h * (1 - cos_d**2)
    azimuth = np.clip((wi[:, 2] - wo[:, 2]) ** 2 / (4 * np.maximum(product, 1e-9)), 0, 1)
    x = half_coordinate(np.minimum(sin2_h / (1 + np.maximum(half[:, 2], 0)), 1))
    return x, difference_coordinate(cos_d), azimuth


def azimuth_basis() -> np.ndarray:
    """Return the (32, 6, 7, 4) bilinear weights that take `Material.azimuth` to the knots of `Material.bivariate`."""
    rows, columns = AZIMUTH_KNOTS
    half = np.maximum(0, 1 - np.abs(np.linspace(0, rows - 1, HALF_KNOTS)[:, None] - np.arange(1, rows)))
    difference = np.linspace(0, columns - 1, DIFFERENCE_KNOTS)[:, None]
    difference = np.maximum(0, 1 - np.abs(difference - np.arange(1, columns)))
    return np.einsum("ha,db->hdab", half, difference)


def azimuth_tables(material: Material) -> tuple[np.ndarray, np.ndarray]:
    """Return the (3, 32, 6) tables of the BRDF at e = 0 and e = 1, between which it is linear in e."""
    ratio = np.einsum("hdab,cab->chd", azimuth_basis(), material.azimuth)
    return material.bivariate, material.bivariate * np.exp(ratio)


def cell(coordinate: np.ndarray, knots: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the index of the cell that holds `coordinate` in [0, 1] and the fraction inside it, for uniform knots."""
    position = coordinate * (knots - 1)
    index = np.clip(position.astype(int), 0, knots - 2)
    return index, position - index


def evaluate(material: Material, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """Evaluate the BRDF.

    Args:
        material: The material.
        wi: (N, 3) unit vectors from the surface to the light, in the shading frame (z is the normal).
        wo: (N, 3) unit vectors to the camera.

    Returns:
        (N, 3) float64 linear RGB in 1/sr, without the cosine; zero where either vector is below the horizon.
    """
    wi, wo = np.asarray(wi, np.float64), np.asarray(wo, np.float64)
    x, y, azimuth = coordinates(wi, wo)
    row, a = cell(x, HALF_KNOTS)
    column, b = cell(y, DIFFERENCE_KNOTS)
    zero, one = azimuth_tables(material)
    value = np.zeros((3, len(wi)))
    for table, weight in ((zero, 1 - azimuth), (one, azimuth)):
        lower = (1 - b) * table[:, row, column] + b * table[:, row, column + 1]
        upper = (1 - b) * table[:, row + 1, column] + b * table[:, row + 1, column + 1]
        value += weight * ((1 - a) * lower + a * upper)
    for cosine in (wi[:, 2], wo[:, 2]):
        index, c = cell(np.clip(1 - cosine, 0, 1), SHADOWING_KNOTS)
        value *= (1 - c) * material.shadowing[:, index] + c * material.shadowing[:, index + 1]
    visible = (wi[:, 2] > 0) & (wo[:, 2] > 0)
    return np.where(visible[:, None], value.T, 0.0)


def directional_albedo(material: Material, cosine: np.ndarray, points: int = 5, azimuths: int = 96) -> np.ndarray:
    """Integrate f cos(theta_o) over the outgoing hemisphere; energy is conserved when it is <= 1.

    The quadrature runs over half vectors, Gauss-Legendre inside each cell of the tables, so that peaks narrower than
    a degree are integrated like any other part; the Jacobian is d(wo) = 4 (wi . h) d(h).

    Args:
        material: The material.
        cosine: (A,) cosines of the incident angles.
        points: Quadrature points per cell in theta_h.
        azimuths: Quadrature points in the azimuth of the half vector.

    Returns:
        (A, 3) directional albedo.
    """
    node, weight = np.polynomial.legendre.leggauss(points)
    x = np.linspace(0, 1, HALF_KNOTS)
    step = x[1] - x[0]
    x = (x[:-1, None] + step * (node + 1) / 2).ravel()
    root = x / (2 - x)
    measure = np.tile(weight * step / 2, HALF_KNOTS - 1) * 4 * root**3 * 2 / (2 - x) ** 2  # d(1 - cos theta_h)
    cos_h, phi = 1 - root**4, (np.arange(azimuths) + 0.5) * np.pi / azimuths  # half the circle, by symmetry
    sin_h = np.sqrt(np.maximum(1 - cos_h**2, 0))
    half = np.stack(np.broadcast_arrays(sin_h[:, None] * np.cos(phi), sin_h[:, None] * np.sin(phi), cos_h[:, None]), 2)
    half, measure = half.reshape(-1, 3), np.repeat(measure, azimuths) * 2 * np.pi / azimuths
    result = []
    for cos_i in np.atleast_1d(cosine):
        wi = np.array([np.sqrt(max(1 - cos_i**2, 0)), 0, cos_i])
        projection = half @ wi
        wo = 2 * projection[:, None] * half - wi
        keep = (projection > 0) & (wo[:, 2] > 0)
        weight = (measure * 4 * projection * wo[:, 2])[keep]
        result.append(weight @ evaluate(material, np.broadcast_to(wi, (keep.sum(), 3)), wo[keep]))
    return np.array(result)
