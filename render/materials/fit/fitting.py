"""Fit the library's materials to Neural-BRDF networks and write them as YAML.

python -m render.materials.fit.fitting --networks FILE.npz --out assets/materials [--only NAME ...]
python -m render.materials.fit.fitting --networks FILE.npz --database rgl- --out assets/materials/held-out --only NAME
"""

import argparse
import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import yaml
from tqdm import tqdm

from render.materials import model
from render.materials.categories import category
from render.materials.fit import solver, spheres
from render.materials.fit.network import Brdf, NetworkFile
from render.materials.fit.spheres import Samples
from render.materials.model import Material
from render.shared.errors import InputError, unknown
from render.shared.files import write_text
from render.shared.seeds import generator

TERMS = "MERL BRDF database: research use; cite Matusik et al., A Data-Driven Reflectance Model, SIGGRAPH 2003"
_IMAGE_SIZE, _LIGHTS = 128, 20


@dataclasses.dataclass(frozen=True)
class Database:
    """Where networks come from.

    Attributes:
        title: The data they were trained on.
        terms: Its terms of use.
        prefix: Put before the names of its materials, which the MERL materials do not have.
        family: Category of its materials; None for that of the name.
    """

    title: str
    terms: str
    prefix: str = ""
    family: str | None = None

    def name(self, network: str) -> str:
        """Return the library's name of a network's material."""
        return self.prefix + network.removesuffix("_rgb").replace("_", "-")

    @property
    def source(self) -> str:
        """Where a fit comes from, for its file."""
        return f"fit to the Neural-BRDF network (Sztrajman et al. 2021, MIT licence) of the {self.title}"


DATABASES = {
    "merl": Database("MERL BRDF database (Matusik et al. 2003)", TERMS),
    "rgl-": Database(
        "RGL material database (Dupuy & Jakob 2018)",
        "RGL material database: cite Dupuy & Jakob, An Adaptive Parameterization, SIGGRAPH Asia 2018",
        "rgl-", "held-out",
    ),
    "niel": Database(
        "BRDF measurements of Nielsen et al. 2015",
        "cite Nielsen, Jensen & Ramamoorthi, On Optimal, Minimal BRDF Sampling, SIGGRAPH Asia 2015",
        "nielsen-", "held-out",
    ),
}  # fmt: skip


class Fitter:
    """Fits any number of BRDFs to the same pairs of directions, and measures each on a sphere they do not contain."""

    def __init__(self, samples: int = 60_000, seed: int = 0) -> None:
        """Draw `samples` fitting pairs, and separately 20 lights for the sphere of the metric."""
        self.samples = spheres.fitting_samples(samples, generator(seed, "materials", "fit"))
        self._basis = solver.basis(self.samples.wi, self.samples.wo)
        lights = spheres.hemisphere_lights(_LIGHTS, generator(seed, "materials", "test"))
        self.test = spheres.sphere_image(_IMAGE_SIZE, lights)

    def fit(
        self, name: str, brdf: Brdf, *, family: str | None = None, source: str = "", terms: str = TERMS
    ) -> Material:
        """Fit one material.

        A sample brighter than the metric's clipping level counts by its relative error, as bright as the level, so that
        a mirror peak neither dominates nor is ignored.

        Args:
            name: Its library name.
            brdf: Function of (N, 3) `wi`, `wo` giving the (N, 3) BRDF in 1/sr; reciprocal. NaN where it is not known:
                such pairs are left out of the fit and of its error.
            family: Its category; by default the one of a MERL material of this name.
            source: Where the data come from; by default the networks of the MERL materials.
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
            source=source or DATABASES["merl"].source,
            terms=terms,
            bivariate=bivariate,
            shadowing=shadowing,
            azimuth=azimuth,
        )
        fitted = rounded(conserve_energy(fitted))
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


def rounded(material: Material) -> Material:
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


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the fitter; returns the exit status."""
    parser = argparse.ArgumentParser(
        prog="python -m render.materials.fit.fitting", description=__doc__.split("\n\n")[0]
    )
    parser.add_argument("--networks", type=Path, required=True, help="npz of weights, keys <database>__<name>__<layer>")
    parser.add_argument("--database", default="merl", choices=sorted(DATABASES), help="which networks (default: merl)")
    parser.add_argument("--out", type=Path, required=True, help="folder for <name>.yaml")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="fit these materials only")
    arguments = parser.parse_args(argv)
    try:
        _run(arguments)
    except InputError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    return 0


def _run(arguments: argparse.Namespace) -> None:
    networks = NetworkFile(arguments.networks, arguments.database)
    database = DATABASES[arguments.database]
    names = arguments.only or networks.names
    for name in names:
        if name not in networks.names:
            raise unknown("material", name, networks.names)
    fitter, errors = Fitter(), []
    for name in tqdm(names, desc="fit", disable=None):
        material = fitter.fit(
            database.name(name), networks.brdf(name), family=database.family, source=database.source,
            terms=database.terms,
        )  # fmt: skip
        errors.append(material.fit_error)
        write_text(arguments.out / f"{material.name}.yaml", to_yaml(material))
    sys.stdout.write(f"{len(names)} materials, median sphere error {np.median(errors):.2%}, worst {max(errors):.2%}\n")


if __name__ == "__main__":
    sys.exit(main())
