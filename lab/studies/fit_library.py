"""Fit the library's materials to Neural-BRDF networks and write them as YAML (docs/studies/material-fits.md).

python -m lab.studies.fit_library --networks FILE.npz --out assets/materials [--only NAME ...]
python -m lab.studies.fit_library --networks FILE.npz --database rgl- --out assets/materials/held-out --only NAME

The networks (Sztrajman et al. 2021) have six inputs (the half vector at azimuth zero and the difference vector, both of
Rusinkiewicz 1998), two hidden layers of 21 rectified units, and three outputs y with f = max(exp(y) - 1, 0), the linear
RGB BRDF in 1/sr without the cosine.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from tqdm import tqdm

from render.materials.fit.fitting import Brdf, Fitter, to_yaml
from render.shared.errors import InputError, unknown
from render.shared.files import write_text
from render.shared.imaging.vectors import unit

_LAYERS = (("fc1", (6, 21)), ("b1", (21,)), ("fc2", (21, 21)), ("b2", (21,)), ("fc3", (21, 3)), ("b3", (3,)))


def half_difference(wi: np.ndarray, wo: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the half vector turned to azimuth zero and the difference vector, each (N, 3), of unit (N, 3) vectors."""
    half = unit(wi + wo)
    sine, cosine = np.hypot(half[:, 0], half[:, 1]), half[:, 2]
    azimuth = np.arctan2(half[:, 1], half[:, 0])
    turned_x = np.cos(azimuth) * wi[:, 0] + np.sin(azimuth) * wi[:, 1]
    turned_y = np.cos(azimuth) * wi[:, 1] - np.sin(azimuth) * wi[:, 0]
    difference = np.stack([cosine * turned_x - sine * wi[:, 2], turned_y, sine * turned_x + cosine * wi[:, 2]], 1)
    return np.stack([sine, np.zeros_like(sine), cosine], 1), difference


class NetworkFile:
    """The weights of many networks in one `.npz`, keys `<database>__<name>__<layer>`.

    Args:
        path: The file.
        database: Prefix to read, `merl` for the MERL materials.

    Raises:
        InputError: not an npz file, no network of this database, or a layer missing or of the wrong shape.
    """

    def __init__(self, path: str | Path, database: str = "merl") -> None:
        try:
            with np.load(path) as archive:
                self._weights = {key: archive[key] for key in archive if key.startswith(f"{database}__")}
        except (OSError, ValueError) as error:
            raise InputError(f"{path}: cannot be read as a .npz of network weights ({error})") from error
        self._prefix, self.names = database, sorted({key.split("__")[1] for key in self._weights})
        if not self.names:
            raise InputError(f"{path}: holds no network named {database}__<name>__fc1")
        for name in self.names:
            for layer, shape in _LAYERS:
                found = self._weights.get(f"{database}__{name}__{layer}")
                if found is None or found.shape != shape:
                    raise InputError(f"{path}: layer {database}__{name}__{layer} of shape {shape} is missing")

    def brdf(self, name: str) -> Brdf:
        """Return a function of (N, 3) `wi`, `wo` giving the (N, 3) BRDF, averaged over exchanging them.

        The networks are only nearly reciprocal; exchanging the vectors negates the difference vector's tangential part.

        Raises:
            InputError: no such network.
        """
        if name not in self.names:
            raise unknown("material", name, self.names)
        fc1, b1, fc2, b2, fc3, b3 = (
            self._weights[f"{self._prefix}__{name}__{layer}"].astype(np.float64) for layer, _ in _LAYERS
        )

        def evaluate(wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
            half, difference = half_difference(wi, wo)
            total = np.zeros((len(half), 3))
            for exchange in (np.array([1, 1, 1]), np.array([-1, -1, 1])):
                hidden = np.maximum(np.hstack([half, difference * exchange]) @ fc1 + b1, 0)
                hidden = np.maximum(hidden @ fc2 + b2, 0)
                total += np.maximum(np.expm1(hidden @ fc3 + b3), 0)
            return total / 2

        return evaluate


TERMS = "MERL BRDF database: research use; cite Matusik et al., A Data-Driven Reflectance Model, SIGGRAPH 2003"


@dataclass(frozen=True)
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


def main(argv: Sequence[str] | None = None) -> int:
    """Command line of the fitter; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
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
