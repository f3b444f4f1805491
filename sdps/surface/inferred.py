"""What `infer` finds in photographs: normals, lights, a surface, pictures under other lights, and their files."""

import dataclasses
import platform
import tempfile
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch

from render.records.shards import write_exr
from render.shared.errors import InputError
from render.shared.files import atomic_path, write_json
from render.shared.images import quantise, write_png
from render.shared.progress import stage
from sdps.core.estimate import Estimate
from sdps.core.geometry import Capture, are_near
from sdps.core.integration import Depth, integrate
from sdps.core.metrics import angle_degrees
from sdps.inference.tiles import release_memory, split_rows
from sdps.methods import pretrained
from sdps.methods.fusion.fuse import FusedEstimate
from sdps.photos import Finding, Photographs, write_lights
from sdps.photos.response import display
from sdps.refinement.surroundings.outcome import LowOrderEstimate
from sdps.refinement.trust import RefinedEstimate
from sdps.surface.lamp_distance import Origin, describe_lamps, measure_distances
from sdps.surface.meshing import mesh, step_of, write_mesh
from sdps.surface.relight import Lamps, Residuals, fit_albedo, relit, residuals, trace_light
from sdps.surface.verdict import give_verdict
from sdps.surface.workload import Workload

RELIT = {"from-left": (-0.7, 0.2, 0.7), "from-right": (0.7, 0.2, 0.7), "from-above": (0.0, 0.8, 0.6),
         "grazing": (-0.85, 0.45, 0.25)}  # fmt: skip
_RESULT = "result.json"


@dataclass(frozen=True, eq=False)
class Inference:
    """What was found in a set of photographs.

    Attributes:
        photos: The photographs.
        method: Name of the method.
        estimate: Normals, lights, and what else the method says.
        findings: What the checks said beforehand.
        files: The weights used, by name.
        discontinuities: Depth may jump (`sdps.core.integration.integrate`).
        seconds: Time the method took.
        forecast: What it was said to take beforehand, in seconds and memory.
    """

    photos: Photographs
    method: str
    estimate: Estimate
    findings: tuple[Finding, ...]
    files: dict[str, Path]
    discontinuities: bool
    seconds: float
    forecast: Workload | None = None

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

    @property
    def nearness(self) -> np.ndarray | None:
        """The object's radius over each lamp's distance (L,), given or found (`sdps.core.geometry`); None: distant."""
        given = self.photos.light_nearness
        return self.estimate.nearness if given is None else given

    @property
    def lamp_distances(self) -> np.ndarray:
        """Distances of the lamps in object sizes, (L,) float64; inf of those that count as distant."""
        return measure_distances(self.nearness, len(self.photos))

    @property
    def lamps(self) -> dict[str, Any]:
        """How far away the lamps stood, in words (`text`) and numbers (`sdps.surface.lamp_distance`), JSON ready."""
        photos, refined = self.photos, self.refinement
        found = self.estimate.nearness is not None or (refined is not None and not refined.trust.doubt)
        origin: Origin = "given" if photos.light_nearness is not None else "found" if found else "assumed"
        size = photos.pixel_size and 2.0 * Capture.of(photos.mask, photos.camera).radius * photos.pixel_size
        return describe_lamps(self.lamp_distances, origin, size)

    @property
    def refinement(self) -> RefinedEstimate | None:
        """The estimate with what refinement says; None where nothing was refined."""
        return self.estimate if isinstance(self.estimate, RefinedEstimate) else None

    @property
    def near_lamps(self) -> Lamps | None:
        """Lamps before the surface; None where they count as distant."""
        photos, nearness = self.photos, self.nearness
        return Lamps(Capture.of(photos.mask, photos.camera), self.depth.z, nearness) if are_near(nearness) else None

    @cached_property
    def depth(self) -> Depth:
        """The surface the normals belong to, by least squares."""
        photos = self.photos
        return integrate(self.normals, photos.mask, camera=photos.camera, discontinuities=self.discontinuities)

    @cached_property
    def albedo(self) -> np.ndarray | None:  # (H, W, 3)
        """Lambertian albedo under the lights found, relative; None where no lights were found. Of a method that finds
        none, that of refinement under low-order light, if it was refined.
        """
        if isinstance(self.estimate, LowOrderEstimate):
            return self.estimate.albedo
        if not len(self.light_directions):
            return None
        known = self.photos, self.photos.mask, self.normals, self.light_directions, self.gains
        return fit_albedo(*known, lamps=self.near_lamps)

    @cached_property
    def residuals(self) -> Residuals | None:
        """How far the photographs are from Lambert's law on what was found; None where no lights were found."""
        if self.albedo is None or not len(self.light_directions):
            return None
        known = self.photos, self.photos.mask, self.normals, self.light_directions, self.gains
        return residuals(*known, self.albedo, lamps=self.near_lamps)

    @property
    def expected_error(self) -> np.ndarray | None:
        """Angle to the true normals to expect, (H, W) float32 in degrees; None where neither network nor refinement
        predicts it. Where refinement was not kept it is the network's, if there is one.
        """
        return self.estimate.expected_error

    @cached_property
    def verdict(self) -> str:
        """Why the result is not to be used, with the likeliest reason; empty where nothing speaks against it."""
        found, trust, residual = self.refinement, None, 0.0
        if found is not None:
            trust, residual = found.trust, float(found.refined.pixel_residual[self.photos.mask].mean())
        return give_verdict(self.photos, self.expected_error, self.findings, trust, residual)

    @property
    def gains(self) -> np.ndarray:
        """Intensities (L,) or (L, 3), equal ones where none were found."""
        return self.intensities if len(self.intensities) else np.ones(len(self.photos), np.float32)

    def relit(self) -> dict[str, np.ndarray]:
        """Return the object under lights of our choice, by name, (H, W, 3) float32 linear in [0, 1]."""
        return {name: self.relit_view(name) for name in RELIT}

    def relit_view(self, name: str, part: tuple[slice, ...] = ()) -> np.ndarray:
        """Return one of `relit`, or some of its rows and columns."""
        white = np.ones((1, 1, 1), np.float32)
        albedo = (self.albedo[part] if self.albedo is not None else white) * (0.9 / self._brightest)
        view = relit(self.normals[part], albedo, np.array(RELIT[name]), free=self._shadows[name][part])
        return np.clip(view, 0.0, 1.0, out=view)

    @cached_property
    def _brightest(self) -> float:
        """Where the brightest percent of the albedo begins; 1 where there is none."""
        inside = np.ones(1, np.float32) if self.albedo is None else self.albedo[self.photos.mask]
        return max(float(np.percentile(inside, 99, overwrite_input=True)), 1e-9)

    @cached_property
    def _shadows(self) -> dict[str, np.ndarray]:
        """What each light of `relit` reaches, (H, W) bool."""
        found = {}
        for number, (name, light) in enumerate(RELIT.items(), start=1):
            found[name] = trace_light(self.depth, np.array(light, np.float64))
            stage("relit pictures", number, len(RELIT))
        return found

    def summary(self) -> dict[str, Any]:
        """Return what a reader needs to judge the result, JSON ready."""
        photos = self.photos
        facts: dict[str, Any] = {
            "verdict": self.verdict, "method": self.method,
            "weights": {name: str(path) for name, path in self.files.items()},
            "terms": pretrained.terms(self.files.values()),
            "images": len(photos),
            "size": list(photos.shape),
            "scale": photos.scale, "bits": photos.bits,
            "gamma": photos.gamma,
            "mask": photos.mask_origin,
            "mask_pixels": int(photos.mask.sum()),
            "light_directions": _origin(self.light_directions, photos.light_directions),
            "light_intensities": _origin(self.intensities, photos.intensities),
            "lamps": self.lamps,
            **({"balls": [ball.tell(photos.files) for ball in photos.balls]} if photos.balls else {}),
            "camera": photos.camera_summary,
            **_number_camera(photos),
            **({"pixel_size": photos.pixel_size} if photos.pixel_size else {}),
            "frame": "x right, y up, z to the camera; lights from the surface to the light",
            "depth": {"unit": f"{_unit(photos)} towards the camera", "components": self.depth.components,
                      "residual_degrees": round(self.depth.residual, 3)},
            "mesh": {"every": step_of(photos.mask)} | ({"unit": _unit(photos)} if photos.pixel_size else {}),
            "seconds": round(self.seconds, 2),
            **_tell_flat(self.estimate),
            **({} if self.forecast is None else {"forecast": self.forecast.summary()}),
            "notes": list(photos.notes),
            "findings": [dataclasses.asdict(finding) for finding in self.findings],
            "versions": {"python": platform.python_version(), "torch": torch.__version__, "numpy": np.__version__},
        }  # fmt: skip
        found = self.estimate
        if found.stray_light is not None:
            facts["precision"] = found.precision
            facts["stray_light"] = round(float(found.stray_light.mean()), 6)
        if found.confidence is not None:
            facts["light_confidence"] = _by_file(photos, found.confidence, 4)
        if found.expected_light_error is not None:
            facts["expected_light_error_degrees"] = _by_file(photos, found.expected_light_error, 2)
        if self.expected_error is not None:
            facts["expected_normal_error_degrees"] = round(float(self.expected_error[photos.mask].mean()), 2)
        if isinstance(found, RefinedEstimate | LowOrderEstimate):
            facts["refined"] = _about_refined(found, photos)
        if isinstance(self.estimate, FusedEstimate):
            from_network, from_refinement = (round(degrees, 2) for degrees in self.estimate.moved)
            facts["fused"] = {"from_network_degrees": from_network, "from_refinement_degrees": from_refinement}
        if self.residuals is not None:
            facts["lambertian_residual"] = round(self.residuals.overall, 4)
        return facts

    def save(self, out: str | Path) -> list[Path]:
        """Write everything into a folder: normals, lights, depth, meshes, relit views, result.json.

        Every file is written whole; all of them are made before the first is put in place. result.json is removed first
        and put in place last, so that a folder with one holds files of one run.

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
                (out / _RESULT).unlink(missing_ok=True)
                for name in sorted(made, key=lambda name: name.name == _RESULT):
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
        write_png(folder / "normal.png", _encode_normals(normals))
        write_png(folder / "mask.png", mask.astype(np.uint8) * 255)
        if len(self.light_directions):
            write_lights(folder / "lights.json", self.photos.files, self.light_directions, self.gains, self.nearness)
        if self.refinement is not None:
            refined = self.refinement.refined
            _save_array(folder / "albedo.npy", refined.albedo)
            _save_array(folder / "highlights.npy", refined.strength)
            _save_array(folder / "residual.npy", refined.pixel_residual)
        elif isinstance(self.estimate, LowOrderEstimate) and self.albedo is not None:
            _save_array(folder / "albedo.npy", self.albedo)
        if self.expected_error is not None:
            _save_array(folder / "expected-error.npy", self.expected_error)
        size, every = self.photos.pixel_size, step_of(mask)
        _save_array(folder / "depth.npy", self.depth.z * np.float32(size) if size else self.depth.z)
        colour = None
        if self.albedo is not None:  # for a screen, the brightest percent at white
            colour = np.concatenate([display(self.albedo[rows] / self._brightest) for rows in split_rows(mask.shape)])
        stage("meshes")
        release_memory()
        surface = mesh(self.depth, millimetres=size, colour=colour, normals=normals, every=every)
        for number, suffix in enumerate(("ply", "obj", "glb"), start=1):
            write_mesh(surface, folder / f"mesh.{suffix}")
            stage("meshes", number, 3)
        del surface, colour
        release_memory()
        (folder / "relit").mkdir()
        for name in RELIT:
            shown = [display(self.relit_view(name, (rows,))) for rows in split_rows(mask.shape)]
            write_png(folder / "relit" / f"{name}.png", np.concatenate(shown))
            stage("relit pictures", 1, 1)
        write_json(folder / _RESULT, self.summary())


def check_out(out: Path, photographs: Path) -> None:
    """Refuse to write among the photographs.

    Raises:
        InputError: the two folders are one.
    """
    if out.resolve() == photographs.resolve():
        raise InputError(f"--out {out}: holds the photographs; choose another folder")


def _origin(used: np.ndarray, given: np.ndarray | None) -> str:
    """Return where lights come from, in words."""
    if given is not None:
        return "given"
    return "found" if len(used) else "not found"


def _unit(photos: Photographs) -> str:
    """Return the unit of the files' depth."""
    return "millimetres" if photos.pixel_size else "pixels"


def _number_camera(photos: Photographs) -> dict[str, Any]:
    """Return the camera in numbers, of the pictures as read; nothing of the plain orthographic one."""
    camera = photos.camera
    if not camera.is_perspective and camera.principal is None:
        return {}
    focal = camera.focal if camera.is_perspective else None
    return {"camera_pixels": {"focal": focal, "principal": list(camera.middle(photos.shape))}}


def _by_file(photos: Photographs, values: np.ndarray, digits: int) -> dict[str, float]:
    """Return rounded values (L,) by the names of the photographs; JSON ready."""
    return dict(zip(photos.files, np.round(np.asarray(values, float), digits).tolist(), strict=True))


def _about_refined(found: RefinedEstimate | LowOrderEstimate, photos: Photographs) -> dict[str, Any]:
    """Say how far refinement went, what to expect of it, and which photographs it explains worst; JSON ready."""
    if isinstance(found, LowOrderEstimate):
        return _about_low_order(found, photos.mask)
    refined, start, expected = found.refined, found.start, found.trust
    mask, residual = photos.mask, refined.image_residual
    moved = _mean_angle(refined.normals, start.normals, mask)
    turned = angle_degrees(refined.light_directions, start.light_directions)
    limit = 2.0 * float(np.median(residual))
    return {
        "kept": not expected.doubt,
        "doubt": expected.doubt,
        "normals_moved_degrees": round(moved, 2),
        "lights_moved_degrees": round(float(turned.mean()), 2),
        "expected_normal_error_degrees": round(float(expected.normals[mask].mean()), 2),
        # How far given directions are off, nobody knows; it is not 0.
        **({} if expected.lights is None else {"expected_light_error_degrees": _by_file(photos, expected.lights, 2)}),
        "residual": round(float(refined.pixel_residual[mask].mean()), 4),
        "unexplained": [name for name, value in zip(photos.files, residual, strict=True) if value > limit],
        "body": refined.body.round(4).tolist(),
        "modes": refined.modes.round(4).tolist(),
        "channels": refined.intensities.mean(axis=0).round(4).tolist(),
        "lobes": {"amplitudes": refined.amplitudes.round(4).tolist(), "sharpness": refined.sharpness.round(1).tolist()},
    }


def _about_low_order(found: LowOrderEstimate, mask: np.ndarray) -> dict[str, Any]:
    """Say how far refinement under low-order light went; JSON ready."""
    refined = found.low_order
    return {
        "kept": not refined.doubt,
        "doubt": refined.doubt,
        "light": "from all around, harmonics up to order two",
        "normals_moved_degrees": round(_mean_angle(refined.normals, found.start.normals, mask), 2),
        "expected_normal_error_degrees": round(float(refined.expected[mask].mean()), 2),
        "misfit": [round(value, 5) for value in refined.misfit],
    }


def _encode_normals(normals: np.ndarray) -> np.ndarray:  # (H, W, 3) uint16
    """Return normals as colours, (n + 1) / 2, a few rows at a time."""
    parts = (normals[rows].astype(np.float64) for rows in split_rows(normals.shape))
    return np.concatenate([quantise((some + 1.0) / 2.0, 16) for some in parts])


def _mean_angle(first: np.ndarray, second: np.ndarray, mask: np.ndarray) -> float:
    """Return the mean angle in degrees between vectors (H, W, 3) inside the mask."""
    parts = [angle_degrees(first[rows][mask[rows]], second[rows][mask[rows]]) for rows in split_rows(mask.shape)]
    return float(np.concatenate(parts).mean())


def _save_array(path: Path, array: np.ndarray) -> None:
    with atomic_path(path) as temporary, temporary.open("wb") as handle:
        np.save(handle, np.ascontiguousarray(array, np.float32))


def _tell_flat(found: Estimate) -> dict[str, Any]:
    """Return what is to be said of a flat thing, by its key; nothing of other things."""
    if found.tilt is None:
        return {}
    return {"flat": {"tilt_degrees": round(found.tilt, 2)} | ({"side_by": found.side_by} if found.side_by else {})}
