"""Other analytic models, fitted or published, measured as the project's own is: the tables of a study.

python -m lab.studies.material_models --networks nbrdf_weights.npz --published merl_sgd_abc.json [--only NAME ...]

docs/studies/material-fits.md has what it prints. Each model is a function of (N, 3) `wi`, `wo` to the (N, 3) BRDF in
1/sr: a diffuse term with two GGX lobes per channel (Walter et al. 2007), Disney's principled model (Burley 2012), ABC
(Low et al. 2012) and SGD (Bagher et al. 2012).
"""

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from tqdm import tqdm

from lab.studies.fit_library import DATABASES, NetworkFile
from render.materials import model
from render.materials.fit.fitting import Brdf, Fitter
from render.materials.fit.spheres import Samples, radiance_limit, sphere_error
from render.shared.errors import InputError
from render.shared.files import read_text
from render.shared.imaging.vectors import unit
from render.shared.templates import markdown_table

_FIT_PAIRS = 6000


@dataclass(frozen=True)
class Angles:
    """Cosines of the geometry, each (N,): light, camera, half vector, and light to half vector."""

    light: np.ndarray
    view: np.ndarray
    half: np.ndarray
    difference: np.ndarray


def angles(wi: np.ndarray, wo: np.ndarray) -> Angles:
    """Return the cosines of (N, 3) directions, kept off the horizon by 1e-3."""
    half = unit(wi + wo)
    light, view = np.maximum(wi[:, 2], 1e-3), np.maximum(wo[:, 2], 1e-3)
    return Angles(light, view, np.minimum(half[:, 2], 1), np.clip((wi * half).sum(1), 0, 1))


def ggx(at: Angles, alpha: float) -> np.ndarray:
    """Return the GGX lobe D G / (4 cos cos) with Smith shadowing, without a Fresnel term; (N,)."""
    alpha2 = alpha**2
    normal = alpha2 / (np.pi * (at.half**2 * (alpha2 - 1) + 1) ** 2)
    visible = [cosine + np.sqrt(alpha2 + (1 - alpha2) * cosine**2) for cosine in (at.light, at.view)]
    return normal / (visible[0] * visible[1])


def _schlick(cosine: np.ndarray, f0: float | np.ndarray) -> np.ndarray:
    return f0 + (1 - f0) * (1 - cosine) ** 5


def two_ggx(p: np.ndarray, at: Angles) -> np.ndarray:
    """One channel: p = log kd, then twice log weight, log alpha, logit F0; returns (N,)."""
    value = np.full(len(at.half), np.exp(p[0]) / np.pi)
    for weight, alpha, f0 in (p[1:4], p[4:7]):
        value += np.exp(weight) * ggx(at, np.exp(alpha)) * _schlick(at.difference, _sigmoid(f0))
    return value


def principled(p: np.ndarray, at: Angles) -> np.ndarray:
    """Disney's model; p (12,): base colour, metallic, specular, tint, roughness, sheen, its tint, coat, gloss, gain."""
    base, (metallic, specular, tint, roughness, sheen, sheen_tint, coat, gloss) = _sigmoid(p[:3]), _sigmoid(p[3:11])
    hue = base / max(base @ np.array([0.3, 0.6, 0.1]), 1e-6)
    grazing_i, grazing_o, grazing_d = ((1 - cosine) ** 5 for cosine in (at.light, at.view, at.difference))
    retro = 0.5 + 2 * at.difference**2 * roughness - 1
    diffuse = (1 + retro * grazing_i) * (1 + retro * grazing_o) / np.pi
    f0 = (1 - metallic) * 0.08 * specular * (1 - tint + tint * hue) + metallic * base  # (3,)
    sheen_rgb = sheen * (1 - sheen_tint + sheen_tint * hue)
    alpha = 0.1 * (1 - gloss) + 0.001 * gloss
    clearcoat = (alpha**2 - 1) / (np.pi * np.log(alpha**2) * (1 + (alpha**2 - 1) * at.half**2))
    visible = [1 / (cosine + np.sqrt(0.0625 + 0.9375 * cosine**2)) for cosine in (at.light, at.view)]
    clearcoat = 0.25 * coat * clearcoat * _schlick(at.difference, 0.04) * visible[0] * visible[1]
    lobe = ggx(at, max(roughness**2, 1e-3))[:, None] * _schlick(at.difference[:, None], f0)
    dielectric = np.outer(diffuse, base) + np.outer(grazing_d, sheen_rgb)
    return np.exp(p[11]) * ((1 - metallic) * dielectric + lobe + clearcoat[:, None])


def _sigmoid(value: float | np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-np.clip(value, -30, 30)))


def fit_two_ggx(target: np.ndarray, weight: np.ndarray, at: Angles) -> Callable[[Angles], np.ndarray]:
    """Fit each channel of (N, 3) `target` with (N, 3) residual weights; returns a function of `Angles`."""
    channels = []
    for value, factor in zip(target.T, weight.T, strict=True):
        base = np.log(max(np.median(value) * np.pi, 1e-5))
        starts = [[base, -3, np.log(narrow), -3, -3, np.log(wide), -3] for narrow, wide in ((0.01, 0.1), (0.1, 0.4))]
        channels.append(_best(two_ggx, starts, value, factor, at))
    return lambda where: np.stack([two_ggx(p, where) for p in channels], 1)


def fit_principled(target: np.ndarray, weight: np.ndarray, at: Angles) -> Callable[[Angles], np.ndarray]:
    """Fit Disney's model and an overall scale to (N, 3) `target`; returns a function of `Angles`."""
    base = np.clip(np.median(target, 0) * np.pi, 1e-3, 0.98)
    base = list(np.log(base / (1 - base)))
    starts = [[*base, metal, 0, 0, rough, -2, 0, -2, 1, 0] for metal, rough in ((-3, 0), (3, -1))]
    p = _best(principled, starts, target, weight, at)
    return lambda where: principled(p, where)


def _best(
    form: Callable[..., np.ndarray], starts: list[list[float]], target: np.ndarray, weight: np.ndarray, at: Angles
) -> np.ndarray:
    """Return the parameters of the best local optimum over `starts`."""

    def misfit(p: np.ndarray) -> np.ndarray:
        return np.clip(weight * (form(p, at) - target), -1e6, 1e6).ravel()

    runs = [least_squares(misfit, start, bounds=(-20, 20), max_nfev=60) for start in starts]
    return min(runs, key=lambda run: run.cost).x


def abc(constants: Sequence[float]) -> Brdf:
    """Return the ABC model of published constants (kD rgb, A rgb, B, C, index of refraction)."""
    diffuse, peak = np.array(constants[:3]), np.array(constants[3:6])
    width, power, ior = constants[6:]

    def evaluate(wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
        at = angles(wi, wo)
        g = np.sqrt(np.maximum(ior**2 - 1 + at.difference**2, 0))
        first = (g - at.difference) / (g + at.difference)
        second = (at.difference * (g + at.difference) - 1) / (at.difference * (g - at.difference) + 1)
        fresnel = 0.5 * first**2 * (1 + second**2)
        shadow = 2 * at.half * np.minimum(at.light, at.view) / np.maximum(at.difference, 1e-6)
        lobe = fresnel * np.minimum(shadow, 1) / ((1 + width * (1 - at.half)) ** power * np.pi * at.light * at.view)
        return diffuse / np.pi + np.outer(lobe, peak)

    return evaluate


def sgd(constants: Sequence[Sequence[float]]) -> Brdf:
    """Return the SGD model of published constants (12 RGB triples, the last one the fit's error)."""
    rho_d, rho_s, alpha, power, f0, f1, kap, lam, c, k, theta0, _ = np.array(constants)

    def shadow(cosine: np.ndarray) -> np.ndarray:
        angle = np.maximum(np.arccos(cosine)[:, None] - theta0, 0)
        return np.clip(1 + lam * (1 - np.exp(c * angle**k)), 0, 1)

    def evaluate(wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
        at = angles(wi, wo)
        cos2 = np.maximum(at.half[:, None] ** 2, 1e-6)
        slope = alpha + (1 / cos2 - 1) / alpha
        normal = kap * np.exp(-slope) / (np.pi * slope**power * cos2**2)
        fresnel = f0 - at.difference[:, None] * f1 + (1 - at.difference[:, None]) ** 5 * (1 - f0)
        lobe = fresnel * normal * shadow(at.light) * shadow(at.view) / (at.light * at.view)[:, None]
        return (rho_d + rho_s * np.maximum(lobe, 0)) / np.pi

    return evaluate


def read_published(path: Path, names: Sequence[str]) -> dict[str, Any]:
    """Read JSON with the constants of ABC and SGD, sections `abc` and `sgd`, by material.

    Raises:
        InputError: not such a file, or no constants for one of `names`.
    """
    try:
        constants = json.loads(read_text(path))
        for section in ("abc", "sgd"):
            for name in names:
                if name not in constants[section]:
                    raise InputError(f"{path}: section {section} has no constants for {name!r}")
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise InputError(f"{path}: expected JSON with sections abc and sgd ({error})") from error
    return constants


def compare(
    samples: Samples,
    test: Samples,
    networks: NetworkFile,
    names: Sequence[str],
    errors: Sequence[float],
    published: dict[str, Any],
) -> str:
    """Fit and measure every candidate.

    Args:
        samples: Pairs to fit, of which an even subset is used.
        test: The sphere of the metric.
        networks: The data.
        names: Materials to compare.
        errors: Sphere errors of the project's own model for `names`.
        published: From `read_published`.

    Returns:
        Markdown: a table with one row per model, and one with the errors of each material.
    """
    subset = Samples(*(array[:: max(len(array) // _FIT_PAIRS, 1)] for array in vars(samples).values()))
    at, at_test = angles(subset.wi, subset.wo), angles(test.wi, test.wo)
    rows: dict[str, list[float]] = {"SGD (published)": [], "ABC (published)": [], "Disney": [], "two GGX": []}
    for name in tqdm(names, desc="compare", disable=None):
        brdf = networks.brdf(name)
        target, reference = brdf(subset.wi, subset.wo), brdf(test.wi, test.wo)
        weight = residual_weight(target, subset)
        fits = {
            "SGD (published)": sgd(published["sgd"][name])(test.wi, test.wo),
            "ABC (published)": abc(published["abc"][name])(test.wi, test.wo),
            "Disney": fit_principled(target, weight, at)(at_test),
            "two GGX": fit_two_ggx(target, weight, at)(at_test),
        }
        for key, fit in fits.items():
            rows[key].append(sphere_error(fit, reference, test))
    rows["this project's"] = list(errors)
    return f"{summary(rows, names)}\n{by_material(rows, names)}"


def residual_weight(target: np.ndarray, samples: Samples) -> np.ndarray:
    """Return (N, 3) factors of residuals as the project's own fit weights them, normalised per channel."""
    limit, cosine = radiance_limit(target, samples), samples.wi[:, 2:3]
    weight = np.sqrt(samples.weight)[:, None] * cosine * np.minimum(1, limit / np.maximum(target * cosine, 1e-12))
    return weight / np.maximum(np.sqrt(((weight * target) ** 2).sum(0)), 1e-12)


_PARAMETERS = {"SGD (published)": 33, "ABC (published)": 9, "Disney": 12, "two GGX": 21}


def summary(rows: dict[str, list[float]], names: Sequence[str]) -> str:
    """Return a Markdown table: counts within 10 % and 20 %, the median, and the five worst of each model."""
    tables = model.HALF_KNOTS * model.DIFFERENCE_KNOTS + model.SHADOWING_KNOTS - 1  # S(normal) is 1
    own = 3 * (tables + (model.AZIMUTH_KNOTS[0] - 1) * (model.AZIMUTH_KNOTS[1] - 1))
    table = []
    for key, values in rows.items():
        order = np.argsort(values)[::-1][:5]
        worst = ", ".join(f"{names[index]} {100 * values[index]:.0f}" for index in order)
        within = [sum(value <= bound for value in values) for bound in (0.1, 0.2)]
        count = _PARAMETERS.get(key, own)
        table.append((key, count, *within, f"{100 * np.median(values):.1f} %", worst))
    return markdown_table(("model", "parameters", "<= 10 %", "<= 20 %", "median", "worst five"), table)


def by_material(rows: dict[str, list[float]], names: Sequence[str]) -> str:
    """Return a Markdown table of every material's error in percent, the worst of the last model first."""
    keys = list(rows)
    worst_first = np.argsort(rows[keys[-1]])[::-1]
    table = [(names[index], *(f"{100 * rows[key][index]:.1f}" for key in keys)) for index in worst_first]
    return markdown_table(("material", *keys), table)


def main() -> None:
    """Fit the project's own model to the materials of MERL, then the others, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--networks", type=Path, required=True, help="npz of weights, keys merl__<name>__<layer>")
    parser.add_argument("--published", type=Path, required=True, help="JSON of published ABC and SGD constants")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="compare on these materials only")
    arguments = parser.parse_args()
    networks, fitter = NetworkFile(arguments.networks), Fitter()
    names = arguments.only or networks.names
    published = read_published(arguments.published, names)
    fitted = [fitter.fit(DATABASES["merl"].name(name), networks.brdf(name)) for name in tqdm(names, desc="fit")]
    errors = [material.fit_error for material in fitted]
    sys.stdout.write(compare(fitter.samples, fitter.test, networks, names, errors, published))


if __name__ == "__main__":
    main()
