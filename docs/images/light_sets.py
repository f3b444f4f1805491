"""Draws docs/images/light_sets.jpg: `python docs/images/light_sets.py` in the root of the repository."""

from pathlib import Path

import numpy as np

from pipelines.shared.charts import new_figure
from render.planning import light_sets

SETS = ("grid:96", "rings:96", "dome:96", "hand-held:96", "stage:256", "diligent")


def main() -> None:
    figure = new_figure(9.0, 6.2)
    for place, name in enumerate(SETS, start=1):
        axes = figure.add_subplot(2, 3, place)
        vectors = light_sets.load(name)
        for angle in (15, 30, 45, 60, 75, 90):
            turn = np.linspace(0, 2 * np.pi, 181)
            radius = np.sin(np.radians(angle))
            axes.plot(radius * np.cos(turn), radius * np.sin(turn), color="0.85" if angle < 90 else "0.4", lw=0.7)
        if name.startswith("hand-held"):
            axes.plot(vectors[:, 0], vectors[:, 1], color="0.6", lw=0.8)
        axes.scatter(vectors[:, 0], vectors[:, 1], s=7, color="#1f4fa8", zorder=3)
        furthest = np.degrees(np.arccos(vectors[:, 2].min()))
        axes.set_title(f"{name}, out to {furthest:.0f}°", fontsize=10)
        axes.set(xlim=(-1.05, 1.05), ylim=(-1.05, 1.05), aspect="equal")
        axes.axis("off")
    figure.savefig(Path(__file__).with_suffix(".jpg"), dpi=110, pil_kwargs={"quality": 85})


if __name__ == "__main__":
    main()
