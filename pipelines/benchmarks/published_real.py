"""Published figures for the real benchmarks, to stand beside ours, each with its source.

DiLiGenT's are means over mask pixels or images, of all 96 images, from 8-bit data where the source is known
(docs/benchmarks.md); averages are over ten objects.
"""

from dataclasses import dataclass
from typing import Any

from pipelines.benchmarks import diligent, gourd_apple, light_stage

SDPS = "SDPS-Net, CVPR 2019"
SCPS = "table of SCPS-NIR, ECCV 2022"
SURVEY = "survey of Ju et al., TPAMI 2024"
LINO = "LINO-UniPS, ICLR 2026"


@dataclass(frozen=True)
class PublishedRow:
    """A row of a published table.

    Attributes:
        method: The method.
        source: Where the figures were printed.
        average: The printed average; None where none was.
        figures: By object; empty where only the average is known.
    """

    method: str
    source: str
    average: float | None
    figures: dict[str, float]


def _rows(names: tuple[str, ...], rows: tuple[tuple[Any, ...], ...]) -> tuple[PublishedRow, ...]:
    return tuple(
        PublishedRow(method, source, average, dict(zip(names, figures, strict=True)) if figures else {})
        for method, source, average, figures in rows
    )


_BY_LETTER = ("ball", "bear", "buddha", "cat", "cow", "goblet", "harvest", "pot1", "pot2", "reading")

DILIGENT_DIRECTIONS = _rows(diligent.OBJECTS, (
    ("LCNet_reg", SDPS, 6.68, (4.94, 5.82, 5.62, 7.19, 4.82, 3.90, 12.89, 7.90, 4.19, 9.50)),
    ("LCNet", SDPS, 4.92, (3.27, 4.08, 5.44, 3.47, 2.87, 4.34, 10.36, 4.50, 4.52, 6.32)),
)) + _rows(_BY_LETTER, (
    ("PF14", SCPS, 13.75, (4.90, 5.24, 9.76, 5.31, 16.34, 33.22, 24.99, 2.43, 13.52, 21.77)),
    ("GCNet", SCPS, 3.32, (1.75, 2.44, 2.86, 4.58, 3.15, 2.98, 5.74, 1.41, 2.81, 5.47)),
    ("SCPS-NIR", SCPS, 4.02, (1.43, 1.56, 4.22, 4.41, 4.94, 2.26, 6.41, 3.46, 4.19, 7.34)),
))  # fmt: skip
"""Degrees."""

DILIGENT_INTENSITIES = _rows(diligent.OBJECTS, (
    ("LCNet_reg", SDPS, 0.080, (0.032, 0.051, 0.048, 0.167, 0.074, 0.080, 0.075, 0.141, 0.044, 0.085)),
    ("LCNet", SDPS, 0.068, (0.039, 0.095, 0.058, 0.061, 0.048, 0.048, 0.067, 0.105, 0.073, 0.082)),
)) + _rows(_BY_LETTER, (
    ("PF14", SCPS, 0.088, (0.036, 0.098, 0.053, 0.059, 0.074, 0.223, 0.156, 0.017, 0.044, 0.122)),
    ("GCNet", SCPS, 0.052, (0.027, 0.101, 0.032, 0.075, 0.031, 0.042, 0.065, 0.039, 0.059, 0.048)),
    ("SCPS-NIR", SCPS, 0.037, (0.019, 0.019, 0.021, 0.032, 0.062, 0.042, 0.023, 0.030, 0.082, 0.035)),
))  # fmt: skip

DILIGENT_NORMALS = _rows(diligent.OBJECTS, (
    ("AM07", SDPS, 37.25, (7.27, 31.45, 18.37, 16.81, 49.16, 32.81, 46.54, 53.65, 54.72, 61.70)),
    ("SM10", SDPS, 29.59, (8.90, 19.84, 16.68, 11.98, 50.68, 15.54, 48.79, 26.93, 22.73, 73.86)),
    ("WT13", SDPS, 23.93, (4.39, 36.55, 9.39, 6.42, 14.52, 13.19, 20.57, 58.96, 19.75, 55.51)),
    ("LM13", SDPS, 27.63, (22.43, 25.01, 32.82, 15.44, 20.57, 25.76, 29.16, 48.16, 22.53, 34.45)),
    ("PF14", SDPS, 16.66, (4.77, 9.54, 9.51, 9.07, 15.90, 14.92, 29.93, 24.18, 19.53, 29.21)),
    ("LC18", SDPS, 16.30, (9.30, 12.60, 12.40, 10.90, 15.70, 19.00, 18.30, 22.30, 15.00, 28.00)),
    ("UPS-FCN", SDPS, 16.02, (6.62, 14.68, 13.98, 11.23, 14.19, 15.87, 20.72, 23.26, 11.91, 27.79)),
    ("LCNet + L2", SDPS, 15.73, (4.90, 11.12, 9.72, 9.35, 14.70, 14.86, 18.29, 20.11, 25.08, 29.17)),
    ("LCNet + IS18", SDPS, 16.46, (6.37, 15.64, 10.58, 8.48, 12.24, 13.94, 18.54, 23.78, 29.31, 25.69)),
    ("UPS-FCN deep+mask", SDPS, 13.62, (3.96, 12.16, 11.13, 7.19, 11.11, 13.06, 18.07, 20.46, 11.84, 27.22)),
    ("LCNet_reg + NENet", SDPS, 11.03, (3.87, 8.97, 8.04, 15.98, 8.36, 9.42, 11.49, 16.99, 8.83, 18.38)),
    ("SDPS-Net", SDPS, 9.51, (2.77, 8.06, 8.14, 6.89, 7.50, 8.97, 11.91, 14.90, 8.48, 17.43)),
)) + _rows(_BY_LETTER, (
    ("Kaya et al. 2021", SURVEY, 11.62, (3.78, 5.96, 13.14, 7.91, 10.85, 11.94, 25.49, 8.75, 10.17, 18.22)),
    ("Sarno et al. 2022", SURVEY, 9.15, (3.46, 5.48, 10.00, 8.94, 6.04, 9.78, 17.97, 7.76, 7.10, 15.02)),
    ("GCNet + PS-FCN", SCPS, 8.70, (2.50, 5.60, 8.60, 7.90, 7.80, 9.60, 16.20, 7.20, 7.10, 14.90)),
    ("ReDDLE-Net", SURVEY, 8.21, (2.65, 6.04, 7.28, 8.76, 6.80, 8.42, 12.28, 7.82, 7.99, 14.03)),
    ("LERPS", SURVEY, 7.92, (2.41, 6.93, 8.84, 7.43, 6.36, 8.78, 11.57, 8.32, 7.01, 11.51)),
    ("SCPS-NIR", SCPS, 7.05, (1.24, 3.82, 9.28, 4.72, 5.53, 7.12, 14.96, 6.73, 6.50, 10.54)),
    ("UniPS", LINO, 14.70, (4.90, 9.10, 19.40, 13.00, 11.60, 24.20, 25.20, 10.80, 9.90, 18.80)),
    ("SDM-UniPS", LINO, 5.80, (1.50, 3.60, 7.50, 5.40, 4.50, 8.50, 10.20, 4.70, 4.10, 8.20)),
    ("Uni MS-PS", LINO, 5.01, (1.92, 3.14, 6.16, 3.60, 4.04, 6.35, 8.84, 4.08, 4.88, 7.09)),
    ("LINO-UniPS", LINO, 4.65, (1.74, 2.64, 6.12, 3.38, 3.99, 5.17, 8.58, 4.07, 4.14, 6.67)),
    ("PS-FCN, true lights", SURVEY, 8.39, ()),
    ("CNN-PS, true lights", SURVEY, 7.62, ()),
    ("PS-FCN (Norm.), true lights", SURVEY, 7.39, ()),
    ("NormAttention-PSN, true lights", SURVEY, 6.83, ()),
    ("GR-PSN, true lights", SURVEY, 6.55, ()),
    ("PX-Net, true lights", SURVEY, 6.33, ()),
))  # fmt: skip
"""Degrees."""

GOURD_APPLE_DIRECTIONS = _rows(gourd_apple.OBJECTS, (
    ("LCNet", SDPS, 6.83, (9.31, 4.07, 7.11)),
    ("PF14", SCPS, 17.92, ()),
    ("GCNet", SCPS, 7.44, ()),
    ("SCPS-NIR", SCPS, 2.07, ()),
))  # fmt: skip
GOURD_APPLE_INTENSITIES = _rows(gourd_apple.OBJECTS, (
    ("LCNet", SDPS, 0.113, (0.106, 0.048, 0.186)),
    ("PF14", SCPS, 0.178, ()),
    ("GCNet", SCPS, 0.112, ()),
    ("SCPS-NIR", SCPS, 0.092, ()),
))  # fmt: skip
LIGHT_STAGE_DIRECTIONS = _rows(light_stage.OBJECTS, (
    ("LCNet", SDPS, 13.61, (6.57, 16.06, 15.95, 19.84, 11.60, 11.62)),
))  # fmt: skip
LIGHT_STAGE_INTENSITIES = _rows(light_stage.OBJECTS, (
    ("LCNet", SDPS, 0.221, (0.212, 0.170, 0.214, 0.199, 0.286, 0.248)),
))  # fmt: skip
