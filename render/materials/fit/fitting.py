"""Fit the built-in model to any BRDF and write it as YAML; lab/studies/fit_library.py made the library so."""

import dataclasses
import json
from collections.abc import Callable

import numpy as np
import yaml

from render.materials import model
from render.materials.categories import category
from render.materials.fit import solver, spheres
from render.materials.fit.spheres import Samples
from render.materials.model import Material
from render.shared.errors import InputError
from render.shared.seeds import generator

Brdf = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Of (N, 3) `wi`, `wo`, unit vectors in the frame of the surface: the (N, 3) BRDF in 1/sr."""

_IMAGE_SIZE, _LIGHTS = 128, 20


class Fitter:
    """Fits any number of BRDFs to the same pairs of directions, and measures each on a sphere they do not contain."""

    def __init__(self, samples: int = 60_000, seed: int = 0) -> None:
        """Draw `samples` fitting pairs, and separately 20 lights for the sphere of the metric."""
        self.samples = spheres.fitting_samples(samples, generator(seed, "materials", "fit"))
        self._basis = solver.basis(self.samples.wi, self.samples.wo)
        lights = spheres.hemisphere_lights(_LIGHTS, generator(seed, "materials", "test"))
        self.test = spheres.sphere_image(_IMAGE_SIZE, lights)

    def fit(self, name: str, brdf: Brdf, *, family: str | None = None, source: str = "", terms: str = "") -> Material:
        """Fit one material.

        A sample brighter than the metric's clipping level counts by its relative error, as bright as the level, so that
        a mirror peak neither dominates nor is ignored.

        Args:
            name: Its library name.
            brdf: Function of (N, 3) `wi`, `wo` giving the (N, 3) BRDF in 1/sr; reciprocal. NaN where it is not known:
                such pairs are left out of the fit and of its error.
            family: Its category; by default the one of a MERL material of this name.
            source: Where the data come from.
            terms: Terms of use of the data.

        Returns:
            The material with tables as written to YAML (rounded), albedo at most 1, and its error on the test sphere.

        Raises:
            InputError: the BRDF is known nowhere, or zero everywhere.
        """
        target = brdf(self.samples.wi, self.samples.wo)
        known = np.all(np.isfinite(target), axis=1)
        if not target[known].any():
            raise InputError(f"material {name!r} is black or unknown in every direction: nothing to fit")
        samples, basis, target = _subset(self.samples, known), self._basis, target[known]
        if not known.all():
            basis = solver.Basis(*(rows[known] for rows in vars(basis).values()))
        limit = max(spheres.radiance_limit(target, samples), 1e-6)
        cosine = samples.wi[:, 2]
        channels = []
        for channel in target.T:
            weight = samples.weight * (cosine * np.minimum(1, limit / np.maximum(channel * cosine, 1e-12))) ** 2
            channels.append(solver.tables(solver.Channel(basis, channel, weight, 1e-4 * limit).solve()))
        bivariate, shadowing, azimuth = (np.stack(tables) for tables in zip(*channels, strict=True))
        fitted = Material(
            name=name,
            category=category(name) if family is None else family,
            source=source,
            terms=terms,
            bivariate=bivariate,
            shadowing=shadowing,
            azimuth=azimuth,
        )
        fitted = round_tables(conserve_energy(fitted))
        return dataclasses.replace(fitted, fit_error=round(self.error(fitted, brdf), 4))

    def error(self, material: Material, brdf: Brdf) -> float:
        """Return the relative RMS error of the sphere, `spheres.sphere_error`, where the BRDF is known."""
        reference = brdf(self.test.wi, self.test.wo)
        known = np.all(np.isfinite(reference), axis=1)
        test = _subset(self.test, known)
        return spheres.sphere_error(model.evaluate(material, test.wi, test.wo), reference[known], test)


def _subset(samples: Samples, rows: np.ndarray) -> Samples:
    """Return the samples of a (N,) mask."""
    return Samples(*(array[rows] for array in vars(samples).values()))


def conserve_energy(material: Material, limit: float = 0.999) -> Material:
    """Lower S where the directional albedo exceeds `limit`, until it does nowhere.

    Multiplying S at one incident angle lowers the albedo there and, by reciprocity, never raises it elsewhere.
    """
    fine = np.linspace(0, 1, 2 * model.SHADOWING_KNOTS - 1)  # the knots and the middles of the cells
    cosine = np.clip(1 - fine, 0.005, 1)
    for _ in range(30):
        albedo = model.directional_albedo(material, cosine)  # (17, 3)
        if albedo.max() <= limit:
            return material
        excess = np.maximum(albedo / limit, 1) ** 1.02
        padded = np.pad(excess, ((1, 1), (0, 0)), mode="edge")
        excess = np.maximum(excess, np.maximum(padded[:-2], padded[2:]))[::2]  # (9, 3)
        shadowing = material.shadowing / excess.T
        material = dataclasses.replace(
            material,
            shadowing=shadowing / shadowing[:, :1],
            bivariate=material.bivariate * shadowing[:, :1, None] ** 2,
        )
    return material


def round_tables(material: Material) -> Material:
    """Round the tables to the digits that `to_yaml` writes."""
    digits = np.vectorize(lambda value: float(f"{value:.4g}"))
    return dataclasses.replace(
        material,
        bivariate=digits(material.bivariate),
        shadowing=digits(material.shadowing),
        azimuth=np.round(material.azimuth, 2),
    )


def to_yaml(material: Material) -> str:
    """Write a material as YAML: one row of a table a line, a block of rows per colour channel."""
    lines = [f"{key}: {_plain(getattr(material, key))}" for key in ("name", "category", "fit_error", "model")]
    lines += [f"{key}: {json.dumps(getattr(material, key))}" for key in ("source", "terms")]
    lines.append("# (rgb, theta_h, theta_d) in 1/sr; render/materials/model.py explains the tables")
    for field, digits in (("bivariate", ".4g"), ("azimuth", ".2f")):
        lines.append(f"{field}:")
        for channel in getattr(material, field):
            rows = [", ".join(f"{value + 0.0:{digits}}" for value in row) for row in channel]
            lines += [f"{'- ' if number == 0 else '  '}- [{row}]" for number, row in enumerate(rows)]
    lines.append("shadowing:")
    lines += [f"- [{', '.join(f'{value:.4g}' for value in channel)}]" for channel in material.shadowing]
    return "\n".join(lines) + "\n"


def _plain(value: str | float) -> str:
    """Return a scalar as YAML, in quotes only where it would be read as something else."""
    return str(value) if yaml.safe_load(str(value)) == value else json.dumps(value)
