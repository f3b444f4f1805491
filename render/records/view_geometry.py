"""Where the pixels of a view lie in space, and from where they are seen and lit; NumPy only.

Camera frame: x right, y up, z to the camera, the origin in the middle of the frame, in the plane of the object's
centre; lengths in half image widths. A perspective camera is a pinhole at (0, 0, distance), and the frame spans [-1, 1]
in the plane z = 0, so that a point (X, Y, Z) is seen at the image point (X, Y) / (1 - Z / distance).
"""

import numpy as np


def image_points(shape: tuple[int, ...]) -> np.ndarray:  # (H, W, 2)
    """Return x (right) and y (up) of the centres of H x W pixels, in half image widths, float64."""
    height, width = shape
    x = (2 * np.arange(width) + 1 - width) / width
    y = (height - 1 - 2 * np.arange(height)) / width
    return np.stack(np.meshgrid(x, y), axis=-1)


def points(depth: np.ndarray, camera_distance: float | None = None) -> np.ndarray:  # (H, W, 3)
    """Return the points of the surface that a depth map shows.

    Args:
        depth: (H, W) z of the surface, in half image widths.
        camera_distance: Of a perspective camera, in half image widths; None: orthographic.

    Returns:
        (H, W, 3) float64, camera frame, half image widths.
    """
    image = image_points(depth.shape)
    if camera_distance is not None:
        image = image * (1 - depth / camera_distance)[..., None]
    return np.concatenate([image, depth[..., None]], axis=-1)


def view_directions(shape: tuple[int, ...], camera_distance: float | None = None) -> np.ndarray:  # (H, W, 3)
    """Return, for H x W pixels, the unit vectors from the surface to the camera, float64.

    They are (0, 0, 1) everywhere for an orthographic camera, without a distance.
    """
    if camera_distance is None:
        return np.broadcast_to([0.0, 0.0, 1.0], (*shape, 3)).copy()
    towards = np.concatenate([-image_points(shape), np.full((*shape, 1), camera_distance)], axis=-1)
    return towards / np.linalg.norm(towards, axis=-1, keepdims=True)


def incident(
    places: np.ndarray, directions: np.ndarray, positions: np.ndarray | None, centre: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return from where light arrives at points, and how much.

    Args:
        places: (P, 3) points of the surface.
        directions: (L, 3) unit vectors to the lights, which hold for distant ones.
        positions: (L, 3) positions of near lights; None for distant ones.
        centre: (3,) where near lights have irradiance pi (`centre_of`).

    Returns:
        (L, P, 3) unit vectors to the lights and (L, P) irradiance / pi of a surface that faces them, float64.
    """
    if positions is None:
        shape = (len(directions), len(places))
        return np.broadcast_to(np.asarray(directions, np.float64)[:, None], (*shape, 3)), np.ones(shape)
    towards = np.asarray(positions, np.float64)[:, None] - places
    distance = np.linalg.norm(towards, axis=-1)
    reference = np.linalg.norm(positions - centre, axis=-1)[:, None]
    return towards / distance[..., None], (reference / distance) ** 2


def camera_matrix(size: int, camera_distance: float) -> np.ndarray:  # (3, 3)
    """Return the matrix K of a perspective camera for square images of `size` pixels.

    (u, v, 1) ~ K (X, -Y, distance - Z): u right and v down in pixels, the centre of the first pixel at (0.5, 0.5). The
    focal length is distance x size / 2 pixels.
    """
    focal, middle = camera_distance * size / 2, size / 2
    return np.array([[focal, 0.0, middle], [0.0, focal, middle], [0.0, 0.0, 1.0]])


def field_of_view(camera_distance: float) -> float:
    """Return the angle, in degrees, that the width of the frame spans."""
    return float(np.degrees(2 * np.arctan(1 / camera_distance)))
