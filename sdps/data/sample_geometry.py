"""Where the pixels of a training sample lie, and its lamps, as `sdps.core.geometry` counts them.

Rendered scenes say where lamps stand from the centre of the whole object; in use nobody knows where that is. So a
sample's lamps are those seen from C, the mean of the pixels it shows, and its images are what lamps of equal irradiance
there would give.
"""

from typing import NamedTuple

import numpy as np

from render.records.manifest import SceneSpec
from render.records.view_geometry import image_points, incident
from sdps.core.symmetry import Symmetry

_FAINTEST = 0.05
"""Irradiance, over pi, of a lamp that stands for light from everywhere, at least."""


class Layout(NamedTuple):
    """Pixels of a sample, and its lamps; camera frame, half image widths of the scene.

    Attributes:
        image: (H, W, 2) float64, where each pixel lies in the picture.
        depth: (H, W) float64, z, 0 outside the object.
        camera: Distance of the camera; inf: orthographic.
        positions: (Q, 3) float64, of near lamps; None: distant ones.
        reference: (3,) where near lamps have irradiance pi.
    """

    image: np.ndarray
    depth: np.ndarray
    camera: float
    positions: np.ndarray | None
    reference: np.ndarray

    def turn(self, symmetry: Symmetry) -> "Layout":
        """Return the layout of the turned scene."""
        flat = np.concatenate([self.image, np.zeros((*self.depth.shape, 1))], axis=-1)
        image = symmetry.vectors(symmetry.images(flat, 0))[..., :2]
        positions = None if self.positions is None else symmetry.vectors(self.positions)
        return Layout(image, symmetry.images(self.depth, 0), self.camera, positions, symmetry.vectors(self.reference))

    def select(self, window: tuple[slice, slice]) -> "Layout":
        """Return the layout of a part of the picture."""
        return self._replace(image=self.image[window], depth=self.depth[window])


class Placed(NamedTuple):
    """A layout as networks are given it.

    Attributes:
        places: (H, W, 3) float32, (X - C) / R.
        sights: (H, W, 3) float32, v'.
        directions: (Q, 3) float32, unit, from C to the lamps.
        nearness: (Q,) float32, rho; 0 of distant lamps.
        irradiance: (Q,) float32, at C, over pi.
        covariance: (Q, 3, 3) float32, of the directions that light comes from; 0 of single lamps.
    """

    places: np.ndarray
    sights: np.ndarray
    directions: np.ndarray
    nearness: np.ndarray
    irradiance: np.ndarray
    covariance: np.ndarray

    def mix(self, weights: np.ndarray) -> "Placed":
        """Return the lamps that stand for mixed light: of L lamps, each image has shares (Q, L).

        What faces all lamps is lit by their vectors' sum as by a lamp of that direction and irradiance. How near it is
        is the mean of its parts.
        """
        strengths = (weights * self.irradiance).astype(np.float64)
        vectors = strengths @ self.directions
        lengths = np.linalg.norm(vectors, axis=1).clip(_FAINTEST)
        shares = strengths / strengths.sum(axis=1, keepdims=True)
        means = shares @ self.directions
        squares = np.einsum("ql,li,lj->qij", shares, self.directions, self.directions, dtype=np.float64)
        spread = squares - means[:, :, None] * means[:, None]
        found = vectors / lengths[:, None], shares @ self.nearness, lengths, spread
        directions, nearness, irradiance, covariance = (part.astype(np.float32) for part in found)
        return self._replace(directions=directions, nearness=nearness, irradiance=irradiance, covariance=covariance)


def lay_out(scene: SceneSpec, depth: np.ndarray, mask: np.ndarray, chosen: np.ndarray) -> Layout:
    """Return the layout of a scene's pixels (H, W), and of the lamps `chosen`."""
    positions = scene.light_positions()
    return Layout(
        image=image_points(mask.shape), depth=np.where(mask, depth, 0.0).astype(np.float64),
        camera=scene.view.camera_distance or np.inf,
        positions=None if positions is None else positions[chosen].astype(np.float64),
        reference=np.array([*scene.view.offset, 0.0]),
    )  # fmt: skip


def place(layout: Layout, mask: np.ndarray, directions: np.ndarray) -> Placed:
    """Return a layout as networks are given it.

    Args:
        layout: The pixels and lamps.
        mask: (H, W) bool.
        directions: (Q, 3) unit, of distant lamps.
    """
    image, depth, camera, positions, reference = layout
    inside, perspective = depth[mask], np.isfinite(camera)
    mean = inside.mean() if len(inside) else 0.0
    if perspective and len(inside):
        mean = camera - float(np.exp(np.log(camera - inside).mean()))
    shrunk = 1.0 - mean / camera
    points = np.concatenate([image * (1.0 - depth / camera)[..., None], depth[..., None]], axis=-1)
    seen = image[mask] if len(inside) else image.reshape(-1, 2)
    pixel = float(np.abs(np.diff(image, axis=1)).max())
    radius = float(np.ptp(seen, axis=0).max() + pixel) / 2 * shrunk
    centre = np.array([*(seen.mean(axis=0) * shrunk), mean])
    tilts = -image / camera if perspective else np.zeros_like(image)
    nearness = np.zeros(len(directions))
    if positions is not None:
        nearness = radius / np.linalg.norm(positions - centre, axis=1)
    seen_from, irradiance = incident(centre[None], directions, positions, reference)
    sights = np.concatenate([tilts, np.ones((*depth.shape, 1))], axis=-1)
    covariance = np.zeros((len(directions), 3, 3))
    found = (
        (points - centre) / radius * mask[..., None], sights, seen_from[:, 0], nearness, irradiance[:, 0], covariance,
    )  # fmt: skip
    return Placed(*(np.ascontiguousarray(part, np.float32) for part in found))
