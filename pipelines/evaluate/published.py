"""The paper's figures for MERL-Test, to stand beside ours (SDPS-Net, tables of sec. 5.1).

Each row: (row of the paper, model) and its figures on sphere and bunny.
"""

from typing import Any

LIGHTING = {  # (direction in degrees, intensity) on sphere, on bunny
    "A0": ("LCNet", (3.47, 0.082), (5.38, 0.089)),
    "A1": ("LCNet_reg", (4.10, 0.104), (5.46, 0.094)),
    "A2": ("LCNet w/o mask", (5.46, 0.104), (8.85, 0.144)),
    "A3": ("LCNet_local", (6.87, 0.198), (9.98, 0.255)),
}
NORMALS = {  # MAE in degrees on sphere, on bunny
    "B0": ("PS-FCN, true lights", 2.66, 3.80),
    "B1": ("LCNet + NENet", 2.71, 4.09),
    "B2": ("LCNet + PS-FCN", 3.19, 4.67),
    "B3": ("LCNet_reg + NENet on its lights", 3.22, 4.99),
    "B4": ("LCNet_reg + PS-FCN", 3.73, 4.96),
    "B5": ("UPS-FCN deep+mask", 3.65, 6.41),
    "B6": ("UPS-FCN deep", 4.30, 7.29),
    "B7": ("UPS-FCN wide", 5.61, 8.85),
    "B8": ("UPS-FCN est_light", 6.80, 10.62),
    "B9": ("UPS-FCN retrain", 7.44, 12.34),
}
SHAPES = ("sphere", "bunny")


def figures(table: dict[str, tuple[Any, ...]], row: str, shape: str, count: int = 1) -> tuple[float | None, ...]:
    """Return the paper's `count` figures of a row and shape, None where it has none."""
    if row not in table or shape not in SHAPES:
        return (None,) * count
    found = table[row][1 + SHAPES.index(shape)]
    return found if isinstance(found, tuple) else (found,)
