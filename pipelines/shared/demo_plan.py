"""The plan of `sdps demo`: the minutes of its runs and the size of its evaluation, fitted to the machine.

What a network learns depends on the images it sees, not on the minutes. So steps of every run are timed first, and each
is given the minutes in which it sees what it needs, within a least and a most. Where networks are slow, fewer test
scenes and ways are evaluated. The plan is kept in the output folder, so that a stopped demo goes on with the same one.
"""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

from pipelines.shared.presets import Preset
from render.shared.config import build, to_plain
from render.shared.errors import InputError
from render.shared.files import read_json, write_json

if TYPE_CHECKING:
    from sdps.training.training_config import NormalTraining

PLAN = "plan.json"


@dataclass(frozen=True)
class Need:
    """What a run of the demo is given.

    Attributes:
        images: Images it should see; with these the pair clearly beats least squares (docs/results.md).
        least, most: Limits of its minutes.
    """

    images: int
    least: float
    most: float


NEEDS = {
    "early": Need(images=38_000, least=2.5, most=7.0),
    "lcnet-soft": Need(images=12_000, least=5.0, most=7.0),
    "nenet-plus": Need(images=22_000, least=7.0, most=10.0),
}
_OTHER_MINUTES = 5.0
"""Setting up, rendering of training and test scenes, and the page."""
_EVALUATION_MINUTES = 6.0
_EVALUATIONS = ((16, ("sdps",)), (8, ("sdps",)), (8, ()), (4, ()))
"""Test materials, and pretrained ways besides the pair trained here; the first that fits is chosen."""
_NETWORKS_SHARE = 0.75
"""Of a step's time; loading, augmentation and the optimiser take the rest."""
_FORWARD = 5.0
"""Times as fast as an image of training that one of evaluation is."""


@dataclass(frozen=True, kw_only=True)
class Plan:
    """What the demo does on this machine.

    Attributes:
        arithmetic: What networks compute in, and why.
        images_per_second: Of training, by run.
        minutes: Of training, by run.
        materials: Test materials, the first of the preset's.
        shipped: Pretrained ways besides the pair trained here.
        evaluation_minutes: About.
    """

    arithmetic: str
    images_per_second: dict[str, float]
    minutes: dict[str, float]
    materials: int
    shipped: tuple[str, ...]
    evaluation_minutes: float

    def overrides(self, preset: Preset) -> list[str]:
        """Return the `--set` overrides that carry the plan out."""
        names = ", ".join(preset.test.materials[: self.materials])
        return [
            *(f"runs.{name}.minutes={minutes:.1f}" for name, minutes in self.minutes.items()),
            f"test.materials=[{names}]",
            f"test.shipped=[{', '.join(self.shipped)}]",
        ]

    def describe(self, preset: Preset) -> str:
        """Say what will be done and how long that takes."""
        total = _OTHER_MINUTES + sum(self.minutes.values()) + self.evaluation_minutes
        images = {name: 60 * minutes * self.images_per_second[name] for name, minutes in self.minutes.items()}
        lines = [
            f"Networks compute in {self.arithmetic}.",
            "1. Render the training scenes: about 3 to 5 minutes on two cores.",
            "2. Train, from random weights:",
            *(
                f"   {name}: {self.minutes[name]:.1f} minutes at about {self.images_per_second[name]:.0f} images/s, "
                f"{count:,.0f} images"
                for name, count in images.items()
            ),
            f"3. Render and score {' and '.join(preset.test.shapes)} in {self.materials} materials: about "
            f"{self.evaluation_minutes:.0f} minutes.",
            "4. Regenerate test scenes in materials of your choice: seconds.",
            f"In all about {total:.0f} minutes. Stopped with Ctrl-C, the same command goes on where it was.",
        ]
        short = [name for name, count in images.items() if count < 0.8 * NEEDS[name].images]
        if short:
            lines.append(
                f"This machine is slower than those the demo is made for: expect less of {', '.join(short)}, or give "
                "them more minutes (--set runs.NAME.minutes=...)."
            )
        return "\n".join(lines) + "\n"


def plan_of(preset: Preset, out: Path) -> Plan:
    """Return the plan kept in the folder, or make and keep one.

    Raises:
        InputError: a plan that cannot be read.
    """
    path = out / PLAN
    if path.is_file():
        try:
            return build(Plan, read_json(path, "delete it"))
        except InputError as error:
            raise InputError(f"{path}: not a plan of `sdps demo` ({error}); delete it") from error
    plan = make_plan(preset, rates(preset))
    write_json(path, to_plain(asdict(plan)))
    return plan


def rates(preset: Preset) -> dict[str, float]:
    """Measure the images per second of every run."""
    from sdps.inference.estimator import default_device
    from sdps.training.step_speed import images_per_second

    return {name: images_per_second(preset.run(name), default_device()) for name in NEEDS}


def make_plan(preset: Preset, rates: dict[str, float]) -> Plan:
    """Return the plan for a machine that trains so many images per second, by run."""
    from sdps.core.precision import arithmetic
    from sdps.inference.estimator import default_device

    minutes = {
        name: round(min(max(need.images / rates[name] / 60.0, need.least), need.most), 1)
        for name, need in NEEDS.items()
    }
    # A scene is 100 images: LCNet sees them in eight views, NENet once, in 16 times the pixels of its crops.
    seconds = 100 * (preset.test.light_views or 1) / rates["lcnet-soft"] / _FORWARD
    crop = cast("NormalTraining", preset.run("nenet-plus").config).crop
    seconds += 100 * (preset.data.size / crop) ** 2 / rates["nenet-plus"] / _FORWARD
    for materials, shipped in _EVALUATIONS:
        evaluation = materials * len(preset.test.shapes) * (1 + len(shipped)) * seconds / 60.0
        if evaluation <= _EVALUATION_MINUTES:
            break
    return Plan(
        arithmetic=arithmetic("auto", default_device()).describe(), images_per_second=rates, minutes=minutes,
        materials=materials, shipped=shipped, evaluation_minutes=round(evaluation, 1),
    )  # fmt: skip
