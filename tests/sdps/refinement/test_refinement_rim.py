"""The rim of an object whose reflectance the model lacks."""

import numpy as np

from render.materials.fit.spheres import hemisphere_lights, shading_frame, sphere_normals
from render.materials.library import load
from render.materials.model import evaluate
from render.shared.imaging.vectors import unit
from sdps.core.metrics import angle_degrees
from sdps.refinement.refine import RefineConfig, refine

_LIGHTS = 40


def test_reflectance_that_the_model_lacks_does_not_flatten_the_rim() -> None:
    rng = np.random.default_rng(0)
    lights, (mask, normals) = hemisphere_lights(_LIGHTS, rng), sphere_normals(42)
    images, start = np.zeros((_LIGHTS, *mask.shape, 3), np.float32), np.zeros((*mask.shape, 3))
    for image, light in zip(images, lights, strict=True):
        ways = shading_frame(normals, light)
        image[mask] = np.pi * evaluate(load("green-latex"), *ways) * np.maximum(ways[0][:, 2:], 0.0)
    start[mask] = unit(normals + rng.normal(0.0, 0.025, normals.shape))
    begun = unit(lights + rng.normal(0.0, 0.025, lights.shape))
    config = RefineConfig(coarse_pixels=700, iterations=600, bounces=0, fine_iterations=0)
    rim, off = normals[:, 2] < 0.4, {}
    for known in (False, True):
        found = refine(images, mask, start, begun, np.ones(_LIGHTS), config=config, rim_known=known)
        error = angle_degrees(found.normals[mask], normals)
        off[known] = float(error[rim].mean()), float(error.mean())
    (rim_free, all_free), (rim_held, all_held) = off.values()
    assert rim_held < 0.6 * rim_free and all_held < 0.7 * all_free, off
