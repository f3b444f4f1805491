"""Sculpture: carved and modelled shapes with folds, creases, limbs, hollows and relief, one per seed.

They stand in for the scanned statues of Wiles and Zisserman (2017) that SDPS-Net's Sculpture set was made of.
"""

from collections.abc import Callable

import numpy as np

from render.shapes.geometry import sdf
from render.shapes.geometry.mesh import TriangleMesh
from render.shapes.geometry.noise import scalar_waves, vector_waves
from render.shapes.geometry.polygonise import polygonise
from render.shapes.geometry.sdf import Field
from render.shapes.sculpture import animals, drapery, forms, statues
from render.shared import seeds

# Recipe and its share of the seeds.
RECIPES: dict[str, tuple[Callable[[np.random.Generator], Field], float]] = {
    "statue": (statues.statue, 0.22),
    "group": (statues.group, 0.12),
    "bust": (statues.bust, 0.14),
    "relief": (statues.relief, 0.08),
    "animal": (animals.animal, 0.14),
    "drapery": (drapery.hanging_cloth, 0.08),
    "vessel": (forms.vessel, 0.08),
    "rock": (forms.rock, 0.07),
    "abstract": (forms.abstract, 0.07),
}


def recipe(seed: int) -> str:
    """Return the name of the recipe that `seed` draws."""
    return _draw_recipe(seeds.generator(seed, "sculpture", "recipe"))


def sculpture(seed: int) -> TriangleMesh:
    """Build the sculpture of `seed`, closed, upright (y up), within the unit sphere."""
    rng = seeds.generator(seed, "sculpture")
    build, _ = RECIPES[recipe(seed)]
    return polygonise(weather(rng, build(rng)), half_size=1.7).normalise()


def weather(rng: np.random.Generator, solid: Field) -> Field:
    """Deform a shape as a whole and age its surface: a slight warp, a tremor of the chisel, and wear."""
    if rng.random() < 0.5:
        solid = sdf.warp(solid, vector_waves(rng, 1.5, 4), rng.uniform(0.01, 0.05))
    if rng.random() < 0.7:
        tremor = scalar_waves(rng, 15, 60, count=24, slope=rng.uniform(0.3, 1.2))
        solid = sdf.displace(solid, tremor, np.exp(rng.uniform(np.log(0.0007), np.log(0.011))))
    return solid


def _draw_recipe(rng: np.random.Generator) -> str:
    """Draw a recipe's name by the shares."""
    shares = np.array([share for _, share in RECIPES.values()])
    return list(RECIPES)[rng.choice(len(shares), p=shares / shares.sum())]
