"""The page and the lines about an inference: photograph, mask, normals, depth, lights, and what to think of them."""

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from pipelines.evaluate.report import page as report
from pipelines.evaluate.report.sections import Section, SectionWriter, Table, Tile
from pipelines.shared import pictures
from pipelines.shared.ball_pictures import draw_ball, draw_circles
from render.shared.progress import stage
from sdps.core.intensities import grey, scale_to_mean

if TYPE_CHECKING:
    from sdps.api import Inference
    from sdps.photos import Finding, Photographs
    from sdps.refinement.trust import RefinedEstimate

MARKS = {"error": "!!", "warning": "! ", "note": "- "}
_MOST_LISTED = 6
_MOST_SIDE = 700  # of the object, in pixels: twice that and more is thinned for the page


def describe(findings: "Sequence[Finding]") -> str:
    """Write the findings, one a line, the gravest first."""
    return "".join(f"{MARKS[finding.level]}{finding.text}{_list_images(finding.images)}\n" for finding in findings)


def name_camera(photos: "Photographs") -> str:
    return photos.camera_summary if photos.camera.is_perspective else "taken for orthographic"


def tell_lamps(result: "Inference") -> str:
    """Return the sentence that says how far away the lamps stood, if any were found."""
    if not len(result.light_directions):
        return "No lamps were found."
    text: str = result.lamps["text"]
    return f"{text[0].upper()}{text[1:]}."


def _list_images(images: Sequence[str]) -> str:
    if not images:
        return ""
    more = f", and {len(images) - _MOST_LISTED} more" if len(images) > _MOST_LISTED else ""
    return f" ({', '.join(images[:_MOST_LISTED])}{more})"


def write_page(path: Path, result: "Inference") -> Path:
    """Write the self-contained page of an inference."""
    stage("page")
    with tempfile.TemporaryDirectory() as temporary:
        writer = _section(result)
        stage("page", 1, 3)
        writer.write(Path(temporary))
        stage("page", 2, 3)
        report.render(path, [Path(temporary)], f"Photometric stereo: {result.photos.folder.resolve().name}", "")
    return path


def _section(result: "Inference") -> SectionWriter:
    """Return everything the page shows."""
    from sdps.surface.inferred import RELIT
    from sdps.surface.views import strip

    photos, mask = result.photos, result.photos.mask
    sure = result.expected_error
    text = (
        f"{'' if sure is None else f'The normals are probably off by {sure[mask].mean():.1f} degrees. '}"
        f"{tell_lamps(result)} The camera is {name_camera(photos)}. {len(photos)} photographs of {photos.shape[1]}x"
        f"{photos.shape[0]} pixels, {photos.bits} bits, tone curve {photos.gamma}; mask: {photos.mask_origin}, "
        f"{int(mask.sum())} pixels. Method: {result.method}. Axes: x right, y up, z to the camera; lights from the "
        "surface to the light."
    )
    section = Section(
        name="photographs",
        title="What was found",
        alert=result.verdict,
        text=text,
        tables=_tables(result),
        pictures_first=True,
    )
    writer, box = SectionWriter(section), _box(mask)
    lit = photos.window(_brightest(result), *box)[0]
    shown = pictures.tone_map(lit, pictures.auto_exposure(lit[None], mask[box]))
    tiles = [
        Tile("a photograph", shown if not photos.balls else _draw_whole(photos, _brightest(result), mask)),
        Tile(f"mask ({photos.mask_origin})", _tint_outside(shown, mask[box])),
        Tile("normals", pictures.normal_map(result.normals[box], mask[box]), "normals"),
        Tile("depth, near is bright", depth_picture(result, box)),
    ]
    if len(result.light_directions):
        tiles.append(Tile("lights, seen from the camera", pictures.light_plot(result.light_directions, result.gains)))
    writer.strip("Photograph, mask, normals, depth, lights", tiles)
    if photos.balls:
        writer.strip("What gave the lights", [draw_ball(ball) for ball in photos.balls])
    writer.strip("The surface from the left, the front and the right", [("", strip(result.depth, 360))], wide=True)
    relit = [(name.replace("-", " "), pictures.tone_map(result.relit_view(name, box))) for name in RELIT]
    writer.strip("Under lights of our choice (matt, with cast shadows)", relit)
    if result.refinement is not None:
        assert result.expected_error is not None  # refinement tells its own
        tiles = _refinement_pictures(result.refinement, result.expected_error[box], box, mask[box])
        writer.strip("Refinement", tiles)
    elif result.expected_error is not None:
        writer.strip("How sure the network is", [_draw_expected_errors(result.expected_error[box], mask[box])])
    return writer


def _draw_whole(photos: "Photographs", part: slice, mask: np.ndarray) -> np.ndarray:
    """Return a whole photograph, every n-th pixel where they are very many, with its balls."""
    every = max(1, max(photos.shape) // (2 * _MOST_SIDE))
    steps = slice(None, None, every), slice(None, None, every)
    seen = photos.window(part, *steps)
    shown = pictures.tone_map(seen[0], pictures.auto_exposure(seen, mask[steps]))
    return draw_circles(shown, photos.balls, photos.scale / every)


def _box(mask: np.ndarray) -> tuple[slice, slice]:
    """Return the rows and columns of the object, with a little room around it; every n-th where they are very many."""
    found = [np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0)]
    side = max(int(np.ptp(places)) for places in found)
    room, every = round(0.06 * side) + 1, max(1, side // _MOST_SIDE)
    rows, columns = (slice(max(places.min() - room, 0), places.max() + room + 1, every) for places in found)
    return rows, columns


def _refinement_pictures(
    found: "RefinedEstimate", expected: np.ndarray, box: tuple[slice, slice], mask: np.ndarray
) -> list[Tile]:
    """Return the normals before and refined, how far they moved, the error to expect of the answer, and what the model
    did not explain.
    """
    from sdps.core.metrics import angle_degrees

    moved = angle_degrees(found.refined.normals[box], found.start.normals[box])
    residual = found.refined.pixel_residual[box]
    most = float(np.percentile(residual[mask], 99))
    return [
        Tile("normals before", pictures.normal_map(found.start.normals[box], mask), "normals"),
        Tile("refined", pictures.normal_map(found.refined.normals[box], mask), "normals"),
        Tile("moved (yellow: 20 degrees)", pictures.error_map(np.where(mask, moved, np.nan), 20.0)),
        _draw_expected_errors(expected, mask),
        Tile(f"not explained (yellow: {most:.2f})", pictures.error_map(np.where(mask, residual, np.nan), most)),
    ]


def _draw_expected_errors(expected: np.ndarray, mask: np.ndarray) -> Tile:
    """Return a picture of the errors to expect, in degrees."""
    return Tile("error to expect (yellow: 20 degrees)", pictures.error_map(np.where(mask, expected, np.nan), 20.0))


def _brightest(result: "Inference") -> slice:
    """Return the slice of the photograph whose light is nearest to 35 degrees off the camera, or of the first."""
    if not len(result.light_directions):
        return slice(0, 1)
    number = int(np.argmin(np.abs(result.light_directions[:, 2] - np.cos(np.radians(35.0)))))
    return slice(number, number + 1)


def _tint_outside(picture: np.ndarray, mask: np.ndarray) -> np.ndarray:  # (H, W, 3) uint8
    """Tint what lies outside the mask, so that a wrong mask is seen at once."""
    tint = np.array([255.0, 80.0, 160.0])
    outside = 0.45 * picture.astype(np.float32) + 0.55 * tint
    return np.where(mask[..., None], picture, outside).astype(np.uint8)


def depth_picture(result: "Inference", box: tuple[slice, ...] = ()) -> np.ndarray:  # (H, W, 3) uint8
    """Return depth as grey, from the farthest (dark) to the nearest (bright) of each component, white outside."""
    z, mask = result.depth.z[box], result.photos.mask[box]
    low, high = np.percentile(z[mask], (0.5, 99.5))
    grey = np.clip((z - low) / max(high - low, 1e-9), 0.0, 1.0) * 225 + 15
    return np.repeat(np.where(mask, grey, 255.0)[..., None], 3, -1).astype(np.uint8)


def _tables(result: "Inference") -> tuple[Table, ...]:
    """Return the checks, the figures and the lights as tables."""
    findings = tuple((finding.level, finding.text + _list_images(finding.images)) for finding in result.findings)
    notes = tuple(("note", note) for note in result.photos.notes)
    checks = Table(title="Checks", header=("level", "what"), rows=(*findings, *notes), prose=(1,))
    facts = result.summary()
    rows = [("seconds", f"{facts['seconds']:.1f}"), ("parts of the surface", str(result.depth.components)),
            ("normals and surface disagree by", f"{result.depth.residual:.2f}°")]  # fmt: skip
    if result.residuals is not None:
        rows.append(("brightness that a matt surface does not explain", f"{result.residuals.overall:.0%}"))
    rows += _refinement_rows(facts)
    if "expected_normal_error_degrees" in facts and ("fused" in facts or "refined" not in facts):
        rows.append(("error of the normals to expect", f"{facts['expected_normal_error_degrees']}°"))
    note = f"Terms of the weights: {facts['terms']}." if facts["terms"] else ""
    tables = [checks, Table(title="Figures", header=("what", "value"), rows=tuple(rows), note=note)]
    if len(result.light_directions):
        relative = scale_to_mean(grey(result.gains))
        body: tuple[tuple[str, ...], ...] = tuple(
            (name, *(f"{value:.3f}" for value in direction), f"{gain:.3f}")
            for name, direction, gain in zip(result.photos.files, result.light_directions, relative, strict=True)
        )
        header: tuple[str, ...] = ("photograph", "x", "y", "z", "intensity / mean")
        if "refined" in facts:
            expected = facts["refined"].get("expected_light_error_degrees")
            body = tuple((*row, f"{expected[row[0]]:.1f}°" if expected else "given, not known") for row in body)
            header = (*header, "error to expect")
        if not facts["lamps"]["far"]:
            away = ["far" if np.isinf(distance) else f"{distance:.2f}" for distance in result.lamp_distances]
            body = tuple((*row, distance) for row, distance in zip(body, away, strict=True))
            header = (*header, "object sizes away")
        tables.append(Table(title="Lights", header=header, rows=body, note=tell_lamps(result)))
    return tuple(tables)


def _refinement_rows(facts: dict[str, Any]) -> list[tuple[str, str]]:
    """Return what the table of figures says of refinement."""
    if "refined" not in facts:
        return []
    about = facts["refined"]
    moved, turned = about["normals_moved_degrees"], about.get("lights_moved_degrees")
    rows = [
        ("refined", "yes" if about["kept"] else f"no: {about['doubt']}"),
        ("refinement moved normals", f"{moved}°") if turned is None else
        ("refinement moved normals, lights", f"{moved}°, {turned}°"),
        ("error of the refined normals to expect", f"{about['expected_normal_error_degrees']}°"),
    ]  # fmt: skip
    if turned is None:  # no lamps lit it
        return rows
    unexplained = about["unexplained"]
    listed = ("photographs not explained", f"{len(unexplained)}{_list_images(unexplained)}")
    return [*rows, listed, *_fusion_rows(facts.get("fused"))]


def _fusion_rows(about: dict[str, float] | None) -> list[tuple[str, str]]:
    """Return what the table of figures says of joining."""
    if about is None:
        return []
    away = f"{about['from_network_degrees']}°, {about['from_refinement_degrees']}°"
    return [("joined normals are away from the network's, the refined ones", away)]
