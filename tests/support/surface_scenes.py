"""Height fields whose depth and normals are known exactly."""

import numpy as np

from sdps.core.geometry import Camera


def grid(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y (H, W) in pixels from the image's centre, y up."""
    return np.meshgrid(np.arange(width) - (width - 1) / 2, (height - 1) / 2 - np.arange(height))


def from_slopes(slope_x: np.ndarray, slope_y: np.ndarray) -> np.ndarray:  # (H, W, 3) float32
    """Return unit normals of a height field with these slopes."""
    normals = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)], axis=-1)
    return (normals / np.linalg.norm(normals, axis=-1, keepdims=True)).astype(np.float32)


def sphere(size: int, radius: float, part: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return depth, normals and mask of a sphere in the middle out to `part` of its radius."""
    x, y = grid(size, size)
    squared = (x**2 + y**2) / radius**2
    z = np.sqrt(np.maximum(1.0 - squared, 0.0))
    mask = squared < part**2
    return radius * z, (np.stack([x / radius, y / radius, z], -1) * mask[..., None]).astype(np.float32), mask


def waves(size: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return depth and normals of a sum of random waves, 4 % of the image high, 16 pixels or more long."""
    rng = np.random.default_rng(seed)
    x, y = grid(size, size)
    z, slope_x, slope_y = np.zeros((3, size, size))
    for _ in range(12):
        across, up = rng.uniform(-1, 1, 2) * 2 * np.pi / 16
        phase, high = rng.uniform(0, 2 * np.pi), 0.01 * size
        z += high * np.sin(across * x + up * y + phase)
        slope_x += high * across * np.cos(across * x + up * y + phase)
        slope_y += high * up * np.cos(across * x + up * y + phase)
    return z, from_slopes(slope_x, slope_y)


def balls(size: int = 96, radius: float = 18.0) -> tuple[np.ndarray, np.ndarray]:
    """Return depth and normals of two balls half sunk in a slanted plane.

    Each meets the plane on its right and stands before it on its left, by up to the radius.
    """
    x, y = grid(size, size)
    z = x.copy()
    normals = from_slopes(np.ones(x.shape), np.zeros(x.shape))
    for right, up in ((-20.0, 20.0), (15.0, -18.0)):
        ball = np.sqrt(np.maximum(radius**2 - (x - right) ** 2 - (y - up) ** 2, 0.0))
        before = (ball > 0) & (right + ball > z)
        z[before] = right + ball[before]
        normals[before] = (np.stack([x - right, y - up, ball], axis=-1) / radius)[before]
    return z, normals


def sphere_before(
    camera: Camera, size: int, radius: float, centre: tuple[float, float, float], part: float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points (H, W, 3), normals and mask of a sphere that a pinhole sees, out to `part` of its outline."""
    rays = -camera.sights((size, size))  # from (0, 0, f)
    off = np.array([0.0, 0.0, camera.focal]) - centre
    squared, half = (rays**2).sum(-1), rays @ off
    under = half**2 - squared * (off @ off - radius**2)
    mask = under > (1.0 - part**2) * radius**2 * squared
    along = (-half - np.sqrt(np.maximum(under, 0.0))) / squared
    points = rays * along[..., None] + [0.0, 0.0, camera.focal]
    return points, ((points - centre) / radius * mask[..., None]).astype(np.float32), mask


def plane_before(camera: Camera, shape: tuple[int, int], normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return points (H, W, 3) and normals of a plane through the origin that a pinhole sees."""
    rays = -camera.sights(shape)
    along = -camera.focal * normal[2] / (rays @ normal)
    normals = np.broadcast_to(normal / np.linalg.norm(normal), (*shape, 3)).astype(np.float32)
    return rays * along[..., None] + [0.0, 0.0, camera.focal], normals


def off_points(found: np.ndarray, truth: np.ndarray, mask: np.ndarray, focal: float) -> np.ndarray:  # (n,)
    """Return how far points (H, W, 3) are from the truth, once this is scaled from the pinhole to the same mean."""
    pinhole = np.array([0.0, 0.0, focal])
    scale = np.exp(np.log(1.0 - found[mask][:, 2] / focal).mean() - np.log(1.0 - truth[mask][:, 2] / focal).mean())
    return np.linalg.norm(found[mask] - (pinhole + scale * (truth[mask] - pinhole)), axis=-1)
