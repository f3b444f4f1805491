"""The reflectance that textures drive: no energy lost or made, reciprocal, drawn with the density it is weighed by."""

import numpy as np
import pytest

from render.backend.jit import dr, mi
from render.materials.kernels.textures.gloss import Appearance, Gloss
from render.materials.textures import microfacet

COUNT = 1 << 16
LOOKS = {"dielectric": (0.3, 0.0), "smooth metal": (0.1, 1.0), "metal": (0.4, 1.0), "rough metal": (1.0, 1.0),
         "between": (0.6, 0.5), "smooth": (0.15, 0.0)}  # fmt: skip
TAN = (0.8, 0.3, 0.1)


def drawn(base: tuple, roughness: float, metallic: float, cosine: float) -> tuple:
    """Return the family, wi, wo and the density of directions drawn with stratified variates."""
    rng = mi.PCG32(size=COUNT)
    lobe, u, v = (rng.next_float32() for _ in range(3))
    wi = mi.Vector3f(float(np.sqrt(1 - cosine**2)), 0, cosine) + dr.zeros(mi.Vector3f, COUNT)
    family = Gloss(Gloss.prepare(Appearance(mi.Color3f(*base), mi.Float(roughness), mi.Float(metallic)), wi.z))
    wo = family.sample_lobe(None, wi, lobe, mi.Point2f(u, v))
    dr.eval(wo)
    return family, wi, wo, family.pdf(None, wi, wo)


def numpy_value(base: tuple, look: tuple, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    count = len(wi)
    return microfacet.evaluate(np.tile(base, (count, 1)), np.full(count, look[0]), np.full(count, look[1]), wi, wo)


@pytest.mark.parametrize("cosine", [0.95, 0.4, 0.1])
@pytest.mark.parametrize("look", LOOKS)
def test_a_white_material_reflects_all_light(look, cosine):
    """The white furnace, whatever the roughness and metallic."""
    family, wi, wo, density = drawn((1, 1, 1), *LOOKS[look], cosine)
    weight = np.array(dr.select(density > 0, family.eval(None, wi, wo) / density, 0), np.float64)[0]
    error = weight.std() / np.sqrt(COUNT)
    assert abs(weight.mean() - 1) < 4.5 * error + 0.002
    assert error < 0.003  # importance sampling


@pytest.mark.parametrize("look", LOOKS)
def test_the_kernel_evaluates_the_numpy_form(look):
    family, wi, wo, _ = drawn(TAN, *LOOKS[look], 0.7)
    above = np.array(wo.z) > 1e-3
    found = np.array(family.eval(None, wi, wo), np.float64).T[above] / np.array(wo.z)[above, None]
    directions = (np.array(vector, np.float64).T[above] for vector in (wi, wo))
    np.testing.assert_allclose(found, numpy_value(TAN, LOOKS[look], *directions), rtol=3e-3, atol=1e-4)


def test_exchanging_the_directions_changes_nothing():
    rng = np.random.default_rng(0)
    wi, wo = (rng.normal(size=(500, 3)) for _ in range(2))
    for vector in (wi, wo):
        vector[:, 2] = np.abs(vector[:, 2])
        vector /= np.linalg.norm(vector, axis=1, keepdims=True)
    for look in LOOKS.values():
        np.testing.assert_allclose(numpy_value(TAN, look, wi, wo), numpy_value(TAN, look, wo, wi), rtol=1e-9)


@pytest.mark.parametrize("look", LOOKS)
def test_directions_are_drawn_with_the_density_they_come_with(look):
    """The share of drawn directions in a part of the sphere is the integral of the density over it."""
    family, wi, wo, _ = drawn(TAN, *LOOKS[look], 0.6)
    height, turn = np.array(wo.z), np.arctan2(np.array(wo.y), np.array(wo.x))
    cells = 400
    z, phi = np.meshgrid(
        (np.arange(cells) + 0.5) / cells, (np.arange(2 * cells) + 0.5) / (2 * cells) * 2 * np.pi - np.pi
    )
    sine = np.sqrt(1 - z**2)
    grid = [np.ascontiguousarray(part.ravel(), np.float32) for part in (sine * np.cos(phi), sine * np.sin(phi), z)]
    towards = dr.gather(mi.Vector3f, wi, dr.zeros(mi.UInt32, z.size))
    lifted = Gloss([dr.gather(mi.Float, mi.Float(value), dr.zeros(mi.UInt32, z.size)) for value in values_of(family)])
    density = np.array(lifted.pdf(None, towards, mi.Vector3f(*grid))) * (2 * np.pi / z.size)
    for low, high in ((0.0, 0.3), (0.3, 0.6), (0.6, 1.0)):
        for side in (True, False):  # towards the mirror direction or away from it
            wanted = (height > low) & (height <= high) & ((np.abs(turn) > np.pi / 2) == side)
            inside = ((z > low) & (z <= high) & ((np.abs(phi) > np.pi / 2) == side)).ravel()
            assert abs(wanted.mean() - density[inside].sum()) < 0.01


def values_of(family: Gloss) -> list:
    return [family._square, family._row, family._share, *family._zero, *family._diffuse, *family._again]
