"""Presets: one YAML file that holds the whole line, and the flags every command shares."""

import argparse
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import Any

from pipelines.shared.stream_config import StreamConfig
from render.planning import light_sets
from render.planning.plan import DataConfig
from render.shared.config import build, check_fields, parse_yaml, read_yaml, to_yaml
from render.shared.errors import InputError, unknown
from render.shared.files import write_text
from render.shared.imaging.sensor import SensorModel
from sdps.inference.inference_config import InferenceConfig
from sdps.methods.pretrained import ALL
from sdps.models.registry import MODELS
from sdps.training import recipes


@dataclass(frozen=True, kw_only=True)
class TestConfig(InferenceConfig):
    """The MERL-Test scenes and how they are scored; how networks are used is in its base.

    Attributes:
        shapes: Shape names.
        materials: Material names, categories, or `all`.
        lights: A fixed light set or a file of directions.
        size: Image side in pixels.
        spp: Camera samples per pixel.
        bounces: Interreflection bounces.
        scale: Radius of the object's unit sphere, in half image widths.
        camera_distance: Distance of a perspective camera (`render.records.manifest.View`), in half image widths; none:
            orthographic.
        light_distance: Distance of near lights from the object's centre, in half image widths; none: distant lights.
        seed: Root seed of the renderer and of the random intensities.
        intensity_range: Range the light intensities are drawn from, uniformly.
        repeats: Draws of random intensities per scene; scores are averaged over them.
        pictures: Scenes shown in the report, per shape.
        shipped: Shipped ways besides what is trained, such as `sdps` or `lcnet-soft+psfcn`; `all` for every one.
        sensor: Cameras of `regenerate --photographs`; not given: all of `render.shared.imaging.sensor.SensorModel`.
    """

    shapes: tuple[str, ...] = ("sphere", "bunny")
    materials: tuple[str, ...] = ALL
    lights: str = "merltest"
    size: int = 128
    spp: int = 128
    bounces: int = 2
    scale: float = 0.95
    camera_distance: float | None = None
    light_distance: float | None = None
    seed: int = 0
    intensity_range: tuple[float, float] = (0.2, 2.0)
    repeats: int = 1
    pictures: int = 5
    shipped: tuple[str, ...] = ALL
    sensor: SensorModel | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        check_fields(self, "at least 1", "spp", "repeats", "pictures")
        if self.size < 16 or self.size % 4:
            raise InputError(f"size must be a multiple of 4 from 16 up, got {self.size}")
        if not 0 < self.intensity_range[0] <= self.intensity_range[1]:
            raise InputError(f"intensity_range must be two rising positive numbers, got {self.intensity_range}")
        if not self.shapes or not self.materials:
            raise InputError("shapes and materials must name at least one each")
        if self.seed < 0 or self.bounces < 0:
            raise InputError("seed and bounces must not be negative")
        light_sets.load(self.lights)


@dataclass(frozen=True, kw_only=True)
class Preset:
    """Everything the commands need; saved, resolved, next to what they write.

    Attributes:
        name: Name of the preset.
        description: One line.
        data: Training and validation scenes.
        train: Models and combinations that `train` trains when none are named.
        lighting: Settings of lighting models, over each model's published recipe.
        normals: Settings of normal models.
        pixels: Settings of models that see one pixel at a time.
        stream: How scenes are rendered while training (`train --stream`).
        runs: Settings of single runs, by name; a run that is not called as its model names it in `base`.
        test: The MERL-Test scenes.
    """

    name: str
    description: str
    data: DataConfig = field(default_factory=DataConfig)
    train: tuple[str, ...] = ("lcnet", "nenet")
    lighting: dict[str, Any] = field(default_factory=dict)
    normals: dict[str, Any] = field(default_factory=dict)
    pixels: dict[str, Any] = field(default_factory=dict)
    stream: StreamConfig = field(default_factory=StreamConfig)
    runs: dict[str, dict[str, Any]] = field(default_factory=dict)
    test: TestConfig = field(default_factory=TestConfig)

    def __post_init__(self) -> None:
        for name in [*MODELS, *self.runs]:
            self.run(name)
        recipes.expand(list(self.train), self.runs)

    def run(self, name: str) -> recipes.Run:
        """Return the resolved settings of a run.

        Raises:
            InputError: an unknown name, key or value.
        """
        return recipes.run(name, {role: getattr(self, role) for role in recipes.CONFIGS}, self.runs)


def names() -> list[str]:
    """Return the names of the presets that travel with the package."""
    folder = resources.files("assets") / "presets"
    return sorted(item.name[:-5] for item in folder.iterdir() if item.name.endswith(".yaml"))


def load(name: str, overrides: list[str] | None = None) -> Preset:
    """Load a preset by name or YAML path and apply `section.field=value` overrides.

    Raises:
        InputError: unknown preset, key or value, naming it.
    """
    if name in names():
        path = Path(str(resources.files("assets") / "presets" / f"{name}.yaml"))
    elif Path(name).suffix in (".yaml", ".yml"):
        path = Path(name)
    else:
        raise unknown("preset", name, names(), "or give the path of a .yaml file")
    values = read_yaml(path)
    for override in overrides or []:
        _apply(values, override)
    if values.pop("joint", None):  # an empty one is in every preset that an earlier version saved
        raise InputError(f"{path}: joint: fine-tuning two models together was removed; delete the section")
    return build(Preset, values)


def _apply(values: dict[str, Any], override: str) -> None:
    """Set one `section.field=value` (the value is YAML) in a nested mapping."""
    key, equals, text = override.partition("=")
    if not equals or not key:
        raise InputError(f"--set {override}: expected section.field=value")
    value = parse_yaml(text, f"--set {override}")
    *sections, last = key.strip().split(".")
    for section in sections:
        values = values.setdefault(section, {})
        if not isinstance(values, dict):
            raise InputError(f"--set {override}: {section} has no fields")
    values[last] = value


def add_common_arguments(parser: argparse.ArgumentParser, default: str = "small") -> None:
    """Declare the flags all long commands share."""
    parser.add_argument("--preset", default=default, help=f"{', '.join(names())}, or a YAML file (default: {default})")
    parser.add_argument("--out", default=None, help="output folder (default: out/<preset>)")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="SECTION.FIELD=VALUE",
                        help="override any field of the preset; may be repeated")  # fmt: skip


def from_arguments(args: argparse.Namespace) -> tuple[Preset, Path]:
    """Return the preset the flags describe, and the output folder."""
    preset = load(args.preset, args.overrides)
    return preset, Path(args.out or f"out/{preset.name}")


def save_resolved(preset: Preset, folder: Path) -> None:
    """Write the resolved configuration to `folder/config.yaml`."""
    write_text(folder / "config.yaml", to_yaml(preset))
