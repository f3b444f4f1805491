"""Folders such as `sdps infer` writes, of analytic surfaces."""

from pathlib import Path

import numpy as np

from render.shared.files import write_json
from render.shared.images import write_png
from sdps.core.geometry import ORTHOGRAPHIC, Camera
from sdps.photos.light_files import write_lights
from sdps.refinement.reflectance import MODES, SHAPES
from sdps.surface.exports.saved_result import SavedResult, read_result

NAMES = ("a 1.png", "b.png", "c.png", "d.png")
LIGHTS = np.array([[0.6, 0.0, 0.8], [0.0, 0.6, 0.8], [-0.48, -0.36, 0.8], [0.0, 0.0, 1.0]])
GAINS = np.array([[1.0, 0.9, 0.8], [1.1, 1.0, 0.9], [0.7, 0.7, 0.6], [1.3, 1.2, 1.1]])

REFINED = {
    "body": [0.0] * SHAPES, "modes": [0.0] * MODES, "channels": [1.0, 1.0, 1.0], "doubt": "",
    "lobes": {"amplitudes": [1.2, 0.8, 0.15], "sharpness": [200.0, 80.0, 30.0]},
}  # fmt: skip
"""A highlight of roughness about 0.35."""


def sphere(size: int = 61, radius: float = 24.0, camera: Camera = ORTHOGRAPHIC):
    """Return normals (H, W, 3), mask (H, W), and z in pixels of a sphere around the camera frame's origin, seen by a
    camera: exact, at the pixels' centres.
    """
    ends = camera.image_points((size, size))
    sights = camera.sights((size, size))  # a point of a line of sight is end + z v', of height z
    start = np.concatenate([ends, np.zeros((size, size, 1))], axis=-1)
    a, b, c = (sights**2).sum(-1), (sights * start).sum(-1), (start**2).sum(-1) - radius**2
    root = b**2 - a * c
    mask = root > 0.2 * radius**2
    z = np.where(mask, (np.sqrt(np.maximum(root, 0.0)) - b) / a, 0.0)
    normals = np.where(mask[..., None], (start + z[..., None] * sights) / radius, 0.0)
    return normals.astype(np.float32), mask, z.astype(np.float32)


def save_result(
    folder: Path,
    surface: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None,
    *,
    camera: Camera = ORTHOGRAPHIC,
    pixel_size: float | None = None,
    nearness: np.ndarray | None = None,
    albedo: bool = True,
) -> SavedResult:
    """Write a result of a surface, by default a sphere, and read it; with `albedo`, a refined one."""
    normals, mask, z = surface or sphere(camera=camera)
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "normal.npy", normals)
    np.save(folder / "depth.npy", z * np.float32(pixel_size or 1.0))
    if albedo:
        painted = np.stack([0.2 + 0.6 * mask, 0.5 * mask, 0.4 * mask], axis=-1)
        np.save(folder / "albedo.npy", painted.astype(np.float32))
        np.save(folder / "highlights.npy", 0.4 * mask.astype(np.float32))
    write_png(folder / "mask.png", mask.astype(np.uint8) * 255)
    write_lights(folder / "lights.json", NAMES, LIGHTS, GAINS, nearness)
    facts: dict[str, object] = {"camera": "orthographic, looking along -z"}
    if camera.is_perspective:
        numbers = {"focal": camera.focal, "principal": list(camera.middle(mask.shape))}
        facts = {"camera": "perspective, given", "camera_pixels": numbers}
    facts |= ({"refined": REFINED} if albedo else {}) | ({"pixel_size": pixel_size} if pixel_size else {})
    write_json(folder / "result.json", facts)
    return read_result(folder)
