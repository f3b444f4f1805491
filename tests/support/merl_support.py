"""MERL tables for the tests, made of BRDFs known in closed form: no licensed file is needed."""

from functools import cache

import numpy as np

from render.materials import library, merl, model


def glossy(wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """A diffuse term with a GGX lobe of roughness 0.1, coloured differently per channel; (N, 3) in 1/sr."""
    half = wi + wo
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    alpha2, difference = 0.1**2, np.clip((wi * half).sum(1), 0, 1)
    normal = alpha2 / (np.pi * (np.minimum(half[:, 2], 1) ** 2 * (alpha2 - 1) + 1) ** 2)
    cosines = [np.maximum(vector[:, 2], 1e-3) for vector in (wi, wo)]
    visible = [cosine + np.sqrt(alpha2 + (1 - alpha2) * cosine**2) for cosine in cosines]
    lobe = normal / (visible[0] * visible[1]) * (0.04 + 0.96 * (1 - difference) ** 5)
    return np.array([0.4, 0.1, 0.02]) / np.pi + lobe[:, None]


def of_library(name: str):  # a function of (N, 3) wi, wo
    """Return the BRDF of a material of the library."""
    return lambda wi, wo: model.evaluate(library.load(name), wi, wo)


@cache
def values(name: str) -> np.ndarray:
    """Return the table, as `merl.write` takes it, of `glossy` or of a material of the library."""
    return merl.tabulate(glossy if name == "glossy" else of_library(name))


def hemisphere(count: int, seed: int) -> np.ndarray:
    """Return (count, 3) directions uniform in projected solid angle."""
    rng = np.random.default_rng(seed)
    radius, azimuth = np.sqrt(rng.random(count)), 2 * np.pi * rng.random(count)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.sqrt(1 - radius**2)], 1)
