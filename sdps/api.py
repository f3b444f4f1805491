"""Two verbs for one's own photographs: `load` a folder of them, `infer` normals, lights and a surface.

from sdps.api import infer, load

photos = load("photographs")           # linear images on demand, mask, lights if they are known
result = infer(photos)                 # or infer(photos, method="pf14"), method="lcnet+psfcn", ...
result.normals                         # (H, W, 3) float32: x right, y up, z to the camera; zero outside the mask
result.light_directions, result.intensities
result.depth.z                         # (H, W) float32, pixels towards the camera
result.save("out")                     # the files of `sdps infer`, but for its report
"""

import dataclasses
import logging
import platform
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from render.records.shards import write_exr
from render.shared.errors import InputError
from render.shared.files import atomic_path, write_json
from render.shared.images import quantise, write_png
from sdps.classical import registry as classical
from sdps.core.estimate import Estimate
from sdps.inference.inference_config import InferenceConfig
from sdps.methods import pretrained
from sdps.methods.parse import parse
from sdps.methods.runner import Runner
from sdps.models.registry import TRUE_LIGHTS
from sdps.photos import Finding, Photographs, check, load, write_lights
from sdps.photos.response import display
from sdps.surface.integration import Depth, integrate
from sdps.surface.meshing import mesh, write_mesh
from sdps.surface.relight import Residuals, fit_albedo, relit, residuals

__all__ = ["Inference", "infer", "load"]

AUTO = "auto"
_LEARNED = ("sdps-plus", "sdps", "lcnet-soft+psfcn", "lcnet+psfcn")
"""Tried in this order; the parts may be trained or shipped one by one."""
_CALIBRATED = ("psfcn", "robust-least-squares")
_FALLBACK = "pf14"
RELIT = {"from-left": (-0.7, 0.2, 0.7), "from-right": (0.7, 0.2, 0.7), "from-above": (0.0, 0.8, 0.6),
         "grazing": (-0.85, 0.45, 0.25)}  # fmt: skip

_log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Inference:
    """What was found in a set of photographs.

    Attributes:
        photos: The photographs.
        method: Name of the method.
        estimate: Normals, lights, and what else the method says.
        findings: What the checks said beforehand.
        files: The weights used, by name.
        discontinuities: Depth may jump (`sdps.surface.integrate`).
        seconds: Time the method took.
    """

    photos: Photographs
    method: str
    estimate: Estimate
    findings: tuple[Finding, ...]
    files: dict[str, Path]
    discontinuities: bool
    seconds: float

    @property
    def normals(self) -> np.ndarray:
        """Unit normals (H, W, 3) float32: x right, y up, z to the camera; zero outside the mask."""
        return self.estimate.normals

    @property
    def light_directions(self) -> np.ndarray:
        """Directions (L, 3) from the surface to the light; (0, 3) of methods that find normals alone."""
        return self.estimate.light_directions

    @property
    def intensities(self) -> np.ndarray:
        """Intensities (L,), known up to one common scale; (0,) of methods that find normals alone."""
        return self.estimate.intensities

    @cached_property
    def depth(self) -> Depth:
        """The surface the normals belong to, by least squares."""
        return integrate(self.normals, self.photos.mask, discontinuities=self.discontinuities)

    @cached_property
    def albedo(self) -> np.ndarray | None:  # (H, W, 3)
        """Lambertian albedo under the lights found, relative; None where no lights were found."""
        if not len(self.light_directions):
            return None
        return fit_albedo(self.photos, self.photos.mask, self.normals, self.light_directions, self.gains)

    @cached_property
    def residuals(self) -> Residuals | None:
        """How far the photographs are from Lambert's law on what was found; None where no lights were found."""
        if self.albedo is None:
            return None
        return residuals(self.photos, self.photos.mask, self.normals, self.light_directions, self.gains, self.albedo)

    @property
    def gains(self) -> np.ndarray:
        """Intensities (L,) or (L, 3), equal ones where none were found."""
        return self.intensities if len(self.intensities) else np.ones(len(self.photos), np.float32)

    def relit(self) -> dict[str, np.ndarray]:
        """Return the object under lights of our choice, by name, (H, W, 3) float32 linear in [0, 1]."""
        return self._relit

    @cached_property
    def _relit(self) -> dict[str, np.ndarray]:
        albedo = self.albedo if self.albedo is not None else np.ones((*self.photos.shape, 3), np.float32)
        inside = albedo[self.photos.mask]
        albedo = albedo * (0.9 / max(float(np.percentile(inside, 99)), 1e-9))
        views = {name: relit(self.normals, albedo, np.array(light), depth=self.depth) for name, light in RELIT.items()}
        return {name: np.clip(view, 0.0, 1.0) for name, view in views.items()}

    def summary(self) -> dict[str, Any]:
        """Return what a reader needs to judge the result, JSON ready."""
        photos = self.photos
        facts = {
            "method": self.method,
            "weights": {name: str(path) for name, path in self.files.items()},
            "terms": pretrained.terms(self.files.values()),
            "images": len(photos),
            "size": list(photos.shape),
            "bits": photos.bits,
            "gamma": photos.gamma,
            "mask": photos.mask_origin,
            "mask_pixels": int(photos.mask.sum()),
            "camera": "orthographic, looking along -z",
            "frame": "x right, y up, z to the camera; lights from the surface to the light",
            "depth": {"unit": "pixels towards the camera", "components": self.depth.components,
                      "residual_degrees": round(self.depth.residual, 3)},
            "seconds": round(self.seconds, 2),
            "notes": list(photos.notes),
            "findings": [dataclasses.asdict(finding) for finding in self.findings],
            "versions": {"python": platform.python_version(), "torch": torch.__version__, "numpy": np.__version__},
        }  # fmt: skip
        if "precision" in self.estimate.diagnostics:
            facts["precision"] = self.estimate.diagnostics["precision"]
            facts["stray_light"] = round(float(self.estimate.diagnostics["stray_light"].mean()), 6)
        confidence = self.estimate.diagnostics.get("confidence")
        if confidence is not None:
            facts["light_confidence"] = dict(
                zip(photos.files, np.round(np.asarray(confidence, float), 4).tolist(), strict=True)
            )
        if self.residuals is not None:
            facts["lambertian_residual"] = round(self.residuals.overall, 4)
        return facts

    def save(self, out: str | Path) -> list[Path]:
        """Write everything into a folder: normals, lights, depth, meshes, relit views, result.json.

        Every file is written whole; all of them are made before the first is put in place.

        Raises:
            InputError: the folder of the photographs, or a disk that refuses the files.
        """
        out = Path(out)
        check_out(out, self.photos.folder)
        try:
            out.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryDirectory(prefix=".infer-", dir=out) as temporary:
                folder = Path(temporary)
                self._write(folder)
                made = sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
                for name in made:
                    (out / name).parent.mkdir(exist_ok=True)
                    (folder / name).replace(out / name)
        except OSError as error:
            raise InputError(f"{out}: cannot be written ({error.strerror or error}); choose another --out") from error
        return [out / name for name in made]

    def _write(self, folder: Path) -> None:
        mask, normals = self.photos.mask, self.normals
        _save_array(folder / "normal.npy", normals)
        channels = {f"normal.{axis}": np.ascontiguousarray(normals[..., k]) for k, axis in enumerate("XYZ")}
        header = {"ps:frame": "x right, y up, z to the camera", "ps:method": self.method}
        write_exr(folder / "normal.exr", [("normal", header, {**channels, "mask": mask.astype(np.float32)})])
        write_png(folder / "normal.png", quantise((normals.astype(np.float64) + 1.0) / 2.0, 16))
        write_png(folder / "mask.png", mask.astype(np.uint8) * 255)
        if len(self.light_directions):
            write_lights(folder / "lights.json", self.photos.files, self.light_directions, self.gains)
        _save_array(folder / "depth.npy", self.depth.z)
        colour = None if self.albedo is None else _display(self.albedo, mask)
        surface = mesh(self.depth, colour=colour, normals=normals)
        for suffix in ("ply", "obj", "glb"):
            write_mesh(surface, folder / f"mesh.{suffix}")
        (folder / "relit").mkdir()
        for name, view in self.relit().items():
            write_png(folder / "relit" / f"{name}.png", display(view))
        write_json(folder / "result.json", self.summary())


def check_out(out: Path, photographs: Path) -> None:
    """Refuse to write among the photographs.

    Raises:
        InputError: the two folders are one.
    """
    if out.resolve() == photographs.resolve():
        raise InputError(f"--out {out}: holds the photographs; choose another folder")


def infer(
    photos: Photographs,
    method: str = AUTO,
    *,
    models: str | Path | None = None,
    config: InferenceConfig | None = None,
    discontinuities: bool = False,
    findings: tuple[Finding, ...] | None = None,
) -> Inference:
    """Estimate normals and lights of photographs.

    Args:
        photos: Of `load`. Lights they carry are used; intensities they do not carry are then taken as equal.
        method: A combination (`sdps`), lights and normals (`lcnet+psfcn`), a normal model or a classical method;
            `auto` for the best there is: a shipped network, or a classical method where there is none.
        models: Folder of trained runs to take weights from before the shipped ones.
        config: How networks are used; the defaults are those of every command.
        discontinuities: Let the depth jump where neighbouring slopes disagree.
        findings: Of `check`, if it ran before.

    Raises:
        InputError: photographs that cannot be used, or a method that is not there or cannot use them, in one line.
    """
    findings = tuple(check(photos)) if findings is None else findings
    grave = next((finding for finding in findings if finding.level == "error"), None)
    if grave is not None:
        raise InputError(f"{photos.folder}: {grave.text}")
    find = partial(pretrained.require, out=None if models is None else Path(models))
    chosen = _automatic(photos, find) if method == AUTO else method
    runner = Runner(_told(chosen, photos, find), find, config)
    began = time.perf_counter()
    estimate = runner.estimate(photos, photos.mask, photos.light_directions, photos.intensities)
    seconds = time.perf_counter() - began
    return Inference(photos, runner.method.name, estimate, findings, runner.files, discontinuities, seconds)


def _told(text: str, photos: Photographs, find: Callable[[str], Path]) -> Any:
    """Return the method of an expression, told the lights where they are known."""
    if photos.light_directions is None:
        method = parse(text, find)
        if TRUE_LIGHTS in (method.lights, method.intensities):
            raise InputError(
                f"--method {text}: is told the lights; give them with --lights, or put a lighting model before it, "
                f"as in lcnet+{text}"
            )
        return method
    if "+" not in text and text in classical.METHODS and not classical.METHODS[text].calibrated:
        _log.warning("%s finds the lights itself; those given are not used", text)
        return parse(text, find)
    return parse(text if "+" in text else f"{TRUE_LIGHTS}+{text}", find)


def _automatic(photos: Photographs, find: Callable[[str], Path]) -> str:
    """Return the best method whose weights are there."""
    names = _LEARNED if photos.light_directions is None else _CALIBRATED
    for name in names:
        try:
            _told(name, photos, find)
        except InputError:
            continue
        return name
    _log.warning("no trained network is there; using %s, which wants a diffuse object", _FALLBACK)
    return _FALLBACK


def _save_array(path: Path, array: np.ndarray) -> None:
    with atomic_path(path) as temporary, temporary.open("wb") as handle:
        np.save(handle, np.ascontiguousarray(array, np.float32))


def _display(albedo: np.ndarray, mask: np.ndarray) -> np.ndarray:  # (H, W, 3) uint8
    """Return colours for a screen, the brightest percent at white."""
    return display(albedo / max(float(np.percentile(albedo[mask], 99)), 1e-9))
