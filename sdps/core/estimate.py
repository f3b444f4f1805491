"""What a method returns, learned or classical, and what it is worth."""

from dataclasses import dataclass, field, replace

import numpy as np


@dataclass(frozen=True, kw_only=True, eq=False)
class Notes:
    """What classical methods note on the way to their answer; a method fills what its docstring names.

    Attributes:
        albedo: (H, W) float32, relative; zero outside the mask.
        gbr: The bas-relief transformation (mu, nu, lambda) from the shared front end to the answer.
        highlights: Whether there were enough highlights to resolve the bas-relief ambiguity.
        energy: What the method minimised, at its answer.
        equal_energy: The same under the transformation of equal light intensities.
        minima: (K, 4) the lowest minima: value, mu, nu, lambda, from the standard form on.
        residual: How far the answer is from the method's model.
        candidates: Number of diffuse maxima.
        intersections: Number of pairs of them that agree on a transformation.
        candidate_map: (H, W) int16, in which image the pixel is a diffuse maximum; -1 in none.
        albedo_groups: Number of groups of one albedo.
        kept: Observations used per pixel.
        unresolved: Share of the pixels whose observations do not determine a normal.
        solved: Number of pixels solved on their own.
        light_mean: Length of the mean light direction: 0 all around, 0.5 a hemisphere.
    """

    albedo: np.ndarray | None = None
    gbr: tuple[float, float, float] | None = None
    highlights: bool | None = None
    energy: float | None = None
    equal_energy: float | None = None
    minima: np.ndarray | None = None
    residual: float | None = None
    candidates: int | None = None
    intersections: int | None = None
    candidate_map: np.ndarray | None = None
    albedo_groups: int | None = None
    kept: int | None = None
    unresolved: float | None = None
    solved: int | None = None
    light_mean: float | None = None


NO_NOTES = Notes()


@dataclass(frozen=True, eq=False)
class Estimate:
    """Normals and lights of one set of images, from a network or a classical method alike.

    Attributes:
        normals: (H, W, 3) float32, unit in the camera frame, zero outside the mask; (0, 0, 3) of methods that give
            lights alone.
        light_directions: (L, 3) float32, unit, from the surface to the light; (0, 3) where none were given or found.
        intensities: (L,) float32, relative (`sdps.core.intensities`); (0,) where there are none.
        seconds: Time the method took.
        expected_error: (H, W) float32, angle to the true normals to expect, in degrees, zero outside the mask; None
            where the method does not predict it.
        expected_light_error: (L,) float32, the same of the light directions.
        nearness: (L,) float32, rho of the lamps (`sdps.core.geometry`), given or found; None: taken for distant.
        light_covariance: (L, 3, 3) float32, of the directions that an image's light comes from, 0 of a lamp; None: all
            light is taken for lamps.
        confidence: (L,) float32, probability of the two likeliest direction classes, multiplied; None where lights were
            not found as classes.
        precision: What networks computed in, `float32` or `bfloat16`; empty where there were none.
        stray_light: (L, 3) float32, taken off the images before networks saw them; None where there were none.
        exposure: Factor applied to the images for each network, `lighting` and `normals`.
        notes: What a classical method notes.
        tilt: Degrees by which the mean plane of a flat thing was tilted before it was made to face the camera; None
            where it was left as it was found.
        side_by: What told whether a flat thing's relief stands out or is hollow; empty where nothing did.
        turned: Whether it was turned inside out on that ground.
    """

    normals: np.ndarray
    light_directions: np.ndarray
    intensities: np.ndarray
    seconds: float = field(default=0.0, kw_only=True)
    expected_error: np.ndarray | None = field(default=None, kw_only=True)
    expected_light_error: np.ndarray | None = field(default=None, kw_only=True)
    nearness: np.ndarray | None = field(default=None, kw_only=True)
    light_covariance: np.ndarray | None = field(default=None, kw_only=True)
    confidence: np.ndarray | None = field(default=None, kw_only=True)
    precision: str = field(default="", kw_only=True)
    stray_light: np.ndarray | None = field(default=None, kw_only=True)
    exposure: dict[str, float] = field(default_factory=dict, kw_only=True)
    notes: Notes = field(default=NO_NOTES, kw_only=True)
    tilt: float | None = field(default=None, kw_only=True)
    side_by: str = field(default="", kw_only=True)
    turned: bool = field(default=False, kw_only=True)

    def without_lights(self) -> "Estimate":
        """Return it without its lights: no lamps lit the images, but light from where these say on average."""
        return replace(
            self, light_directions=np.zeros((0, 3), np.float32), intensities=np.zeros(0, np.float32),
            expected_light_error=None, nearness=None, light_covariance=None, confidence=None,
        )  # fmt: skip


def constant_estimate(count: int, mask: np.ndarray) -> Estimate:
    """Predict a plate facing the camera under `count` equal lights at the camera: what every method has to beat.

    Args:
        count: Number of images.
        mask: (H, W) bool.
    """
    front = np.array([0.0, 0.0, 1.0], np.float32)
    return Estimate(
        normals=mask[..., None] * front,
        light_directions=np.tile(front, (count, 1)),
        intensities=np.ones(count, np.float32),
    )


@dataclass(frozen=True)
class Score:
    """A number with its definition.

    Attributes:
        name: Short name, e.g. `normal_mae`.
        value: The number.
        unit: `deg`, or empty for a ratio.
        definition: One sentence that says exactly what was averaged over what.
    """

    name: str
    value: float
    unit: str
    definition: str
