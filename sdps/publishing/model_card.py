"""The model card: one Markdown page about trained weights, with front matter as model hubs read it.

Everything on it comes from the weights' metadata, the registry, the run's metrics and the data folder's manifest. What
none of them tells is "not recorded".
"""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml

from render.records.manifest import MANIFEST, SceneSpec, read_manifest
from render.records.shards import file_hash
from render.shared.errors import InputError
from render.shared.files import markdown_table, read_text, write_text
from sdps.models import registry
from sdps.models.blocks import parameter_count
from sdps.models.checkpoint import TrainedModel, load_weights
from sdps.models.registry import TRUE_LIGHTS
from sdps.publishing.learning_curves import Rows, read_metrics

UNKNOWN = "not recorded"
_METRICS, _DATASET_CARD = "metrics.jsonl", "DATASET_CARD.md"
_PRESET, _TRAINING = "config.yaml", "training.yaml"  # what `sdps train` leaves beside the weights
_GIVES = {
    "lighting": "direction and relative intensity of the light of every image",
    "second": "direction and relative intensity of the light of every image, from the images and a first estimate of "
    "lights and normals",
    "normals": "the surface normal of every pixel of the object",
    "pixels": "the surface normal of every pixel of the object, each pixel by itself",
}
_DEFINITIONS = {
    "normal_mae": ("degrees", "mean angle between estimated and true normals over the pixels of the mask"),
    "direction_mae": ("degrees", "mean angle between estimated and true light directions over the images"),
    "intensity_error": ("relative", "scale-invariant relative error of the light intensities (SDPS-Net, eq. 4)"),
    "loss": ("", "the loss that training minimises"),
}
_READ_OUTS = {"expectation": "lights read out as expectation over the classes", "peak": "lights read out at the "
              "interpolated peak of the class probabilities"}  # fmt: skip
_LIMITS = """\
- For photometric stereo: one object, a fixed camera, one distant light per image, all images under different lights.
- Trained on rendered images under an orthographic camera and directional lights in front of the object. Near lights,
  perspective, ambient light and the optics of real cameras were not among them.
- Materials in training are opaque. Transmission, subsurface scattering and fluorescence were not among them.
- Input has to be linear: images with gamma, tone mapping or automatic exposure between them break the model's premise.
- The figures above are of scenes like those of training. They are no promise for photographs: measure on your own.
"""


class _Sources(NamedTuple):
    """What a card is made from."""

    run: str  # name of the run, which is that of its folder
    file: str  # name of the weights file
    stored: str  # its size and type of number
    model: TrainedModel
    rows: Rows  # metrics of the run, empty where there are none
    base: str  # model the run trains, `sdps-joint` included
    preset: dict[str, Any]  # resolved, empty where it is not recorded


def write_model_card(
    path: str | Path,
    weights: str | Path,
    data: str | Path | None = None,
    *,
    terms: Sequence[tuple[str, str, str]] = (),
    shipped: str | Path | None = None,
) -> None:
    """Write the card of trained weights; metrics and configuration of the run are looked for beside them.

    Args:
        path: The card, by convention `MODEL_CARD.md` beside the weights.
        weights: The safetensors file, in its run's folder.
        data: The data folder trained on, for its composition.
        terms: Rows of materials, their source and their terms of use; by default, what the data folder's card says.
        shipped: A copy of the weights, rounded, that the card is to travel with.

    Raises:
        InputError: weights that cannot be loaded, a damaged manifest, or an unwritable disk.
    """
    write_text(path, render_card(weights, data, terms, shipped))


def render_card(
    weights: str | Path,
    data: str | Path | None = None,
    terms: Sequence[tuple[str, str, str]] = (),
    shipped: str | Path | None = None,
) -> str:
    """Compose the card; see `write_model_card`."""
    weights = Path(weights)
    model = load_weights(weights)
    metrics = weights.parent / _METRICS
    rows = read_metrics(metrics) if metrics.is_file() and metrics.stat().st_size else []
    run = weights.absolute().parent.name
    file = weights if shipped is None else Path(shipped)
    stored = f"{file.stat().st_size / 1e6:.1f} MB as {'float32' if shipped is None else 'float16'}"
    source = _Sources(run, file.name, stored, model, rows, _base(weights.parent) or model.name, _preset(weights.parent))
    folder = Path(data) if data is not None and (Path(data) / MANIFEST).is_file() else None
    sections = [
        _front_matter(source),
        f"# {weights.stem}\n\n{_about(source)}",
        _input(model),
        _training(source),
        _data(model, folder),
        _validation(source),
        f"## Intended use and limits\n\n{_LIMITS}",
        _licences(folder, terms),
        _repeat(source),
        _load(source),
    ]
    return "\n".join(sections)


def _base(folder: Path) -> str:
    """Return the model of the run, if that is recorded beside the weights."""
    return str(_plain(folder / _TRAINING).get("model", ""))


def _preset(folder: Path) -> dict[str, Any]:
    """Return the resolved preset beside the weights; empty if there is none."""
    values = _plain(folder / _PRESET)
    return values if "data" in values else {}


def _plain(file: Path) -> dict[str, Any]:
    try:
        values = yaml.safe_load(read_text(file))
    except (InputError, yaml.YAMLError):
        return {}
    return values if isinstance(values, dict) else {}


def _front_matter(source: _Sources) -> str:
    values: dict[str, Any] = {
        "library_name": "sdps",
        "license": "unknown",
        "pipeline_tag": "image-to-image",
        "tags": ["photometric-stereo", "surface-normals" if "normal" in _GIVES[source.model.role] else "lighting",
                 "synthetic", source.model.name],
    }  # fmt: skip
    found = _metrics(source)
    if found:
        task = {"type": "image-to-image", "name": "uncalibrated photometric stereo"}
        data = {"type": "rendered", "name": f"manifest {str(source.model.metadata.get('data', UNKNOWN))[:12]}",
                "split": "val"}  # fmt: skip
        scores = [{"type": name, "value": round(value, 4)} for name, value in found.items()]
        result = {"task": task, "dataset": data, "metrics": scores}
        values["model-index"] = [{"name": Path(source.file).stem, "results": [result]}]
    return f"---\n{yaml.safe_dump(values, sort_keys=False)}---\n"


def _about(source: _Sources) -> str:
    entry, model = registry.entry(source.model.name), source.model
    lights = model.metadata.get("lights") or entry.lights
    rows = [
        ("model", f"`{model.name}`: {entry.summary}"),
        ("gives", _GIVES[entry.role]),
        ("parameters", f"{parameter_count(model.network):,}"),
        ("row of the paper's tables (SDPS-Net, CVPR 2019)", entry.paper or "none"),
        ("lights it was trained on", {TRUE_LIGHTS: "the true ones", "": "does not apply", "none": "it is told none"}
         .get(lights, f"those of `{lights}`")),
        ("reconstruction", f"the paper leaves open, and this project decided: {entry.reconstruction}"
         if entry.reconstruction else "no; layers as published or derived from them"),
        ("options of the network", _value(model.options) if model.options else "defaults"),
        ("weights", f"`{source.file}` (safetensors, {source.stored}); loading runs no code"),
    ]  # fmt: skip
    return f"{entry.summary}.\n\n" + markdown_table(("what", "value"), rows)


def _input(model: TrainedModel) -> str:
    """Say what the network takes, from its own attributes and the exposure of its training."""
    network, augmentation = model.network, model.augmentation()
    low, high = augmentation.intensity_range
    mask = getattr(network, "use_mask", False) or getattr(network, "needs_mask", False)
    lines = [
        "Images (L, H, W, 3) of linear radiance, of any overall scale, and the object's mask (H, W); see below for "
        "how to call it.",
        "Frame: x right, y up, z to the camera, for normals and lights. A light direction points from the surface to "
        "the light.",
        f"Exposure `{augmentation.exposure}`, to which `sdps.inference.estimator` brings the images: "
        + (f"mean over the object {augmentation.mean_level:g}, clipped at {augmentation.clip:g}."
           if augmentation.exposure == "mean" else f"as published, clipped at {augmentation.clip:g} in training."),
        f"Relative light intensities from {low:g} to {high:g}.",
        f"The mask {'is an input of the network' if mask else 'is no input of the network'}.",
    ]  # fmt: skip
    if model.role in ("lighting", "second"):
        lines.append("The network sees 128x128; larger images are shrunk.")
    if getattr(network, "needs_lights", False):
        lines.append("It is told the light directions, and images are divided by the light intensities.")
    if getattr(network, "per_pixel", False):
        lines.append("Images are divided by each pixel's norm over the lights.")
    return "## What it expects\n\n" + "".join(f"- {line}\n" for line in lines)


def _training(source: _Sources) -> str:
    metadata, rows = source.model.metadata, source.rows
    seconds, step = metadata.get("seconds"), metadata.get("step")
    facts = [
        ("optimiser steps", UNKNOWN if step is None else f"{step:,}"),
        ("hours", UNKNOWN if seconds is None else f"{seconds / 3600:.2f}"),
        ("computed in", _computed(metadata)),
        ("images per second", _mean(rows, "images_per_second", "{:.0f}")),
        ("share of time waiting for data", _mean(rows, "waiting_share", "{:.1%}")),
        ("last training loss", _last(rows, "loss")),
        ("code version (hash of the package's source)", f"`{metadata.get('code', UNKNOWN)}`"),
    ]
    for use in ("lighting", "normals"):
        if isinstance(metadata.get(use), Mapping):
            facts.append((f"frozen {use} model it was trained with", _value(metadata[use])))
    settings = [(f"`{name}`", _value(value)) for name, value in _flat(metadata["config"])]
    return (
        f"## How it was trained\n\n{markdown_table(('what', 'value'), facts)}\nAll settings, resolved:\n\n"
        f"{markdown_table(('setting', 'value'), settings)}"
    )


def _data(model: TrainedModel, folder: Path | None) -> str:
    """Tell the composition of the data folder, if it is at hand and the one trained on."""
    digest = model.metadata.get("data")
    rows: list[tuple[str, Any]] = [("SHA-256 of the manifest", f"`{digest}`" if digest else UNKNOWN)]
    if model.metadata.get("scenes") is not None:
        rows.append(("scenes per epoch", f"{model.metadata['scenes']:,}"))
    note = ""
    if folder is None:
        rows.append(("composition", UNKNOWN))
    elif digest and digest != file_hash(folder / MANIFEST):
        rows.append(("composition", f"{UNKNOWN}; the data folder at hand has another manifest now"))
    else:
        rows += _composition(read_manifest(folder))
        if (folder / _DATASET_CARD).is_file():
            note = f"\nThe data folder's own `{_DATASET_CARD}` tells how the scenes were made.\n"
    return f"## Data\n\n{markdown_table(('what', 'value'), rows)}{note}"


def _composition(scenes: Sequence[SceneSpec]) -> list[tuple[str, str]]:
    families = Counter(Path(scene.shape.partition(":")[0]).name for scene in scenes)
    return [
        ("scenes", _counts(Counter(scene.split for scene in scenes))),
        ("shape families", _counts(families)),
        ("shapes", f"{len({scene.shape for scene in scenes}):,}"),
        ("materials", f"{len({scene.material for scene in scenes}):,} different"),
        ("lights per scene", _counts(Counter(len(scene.lights) for scene in scenes))),
        ("height and width in pixels", _counts(Counter("x".join(map(str, scene.resolution)) for scene in scenes))),
    ]


def _validation(source: _Sources) -> str:
    """List the validation figures with their definitions."""
    found = _metrics(source)
    if not found:
        return f"## Validation\n\n{UNKNOWN.capitalize()}: the run had no validation scenes.\n"
    config = source.model.metadata["config"]
    rows = [(name, f"{value:.4g}", *_defined(name), _best(source.rows, name)) for name, value in found.items()]
    header = ("metric", "value", "unit", "definition", "best during the run")
    scenes, images = (config.get(name, UNKNOWN) for name in ("validation_scenes", "images"))
    return (
        f"## Validation\n\nMeans over at most {scenes} scenes of split `val`, which training does not see, {images} "
        f"images of each, augmented like those of training.\n\n{markdown_table(header, rows)}"
    )


def _defined(name: str) -> tuple[str, str]:
    """Return unit and definition of a metric."""
    for key, (unit, text) in _DEFINITIONS.items():
        if name.startswith(key):
            how = _READ_OUTS.get(name.removeprefix(f"{key}_"))
            return unit or "-", f"{text}; {how}" if how else text
    return UNKNOWN, UNKNOWN


def _licences(folder: Path | None, terms: Sequence[tuple[str, str, str]]) -> str:
    text = "The licence of these weights is not stated. What they were trained on has terms of its own.\n\n"
    if terms:
        return "## Licences\n\n" + text + markdown_table(("materials", "source", "terms"), terms)
    card = ""
    if folder is not None and (folder / _DATASET_CARD).is_file():
        found = re.search(
            r"^## Licences\n(.*?)(?=^## |\Z)", read_text(folder / _DATASET_CARD), re.DOTALL | re.MULTILINE
        )
        card = found.group(1).strip() if found else ""
    if card:
        return f"## Licences\n\n{text}From the card of the data:\n\n{card}\n"
    return (
        f"## Licences\n\n{text}Terms of the materials and shapes: {UNKNOWN} here; `sdps data card` writes them into "
        "the data folder. Built-in materials with the names of measured ones are fits to the MERL BRDF database: "
        "research use, cite Matusik et al., A Data-Driven Reflectance Model, SIGGRAPH 2003.\n"
    )


def _repeat(source: _Sources) -> str:
    """Give a preset that resolves to this run's settings, and the command that trains it."""
    if source.preset:
        return _repeat_all(source)
    config = source.model.metadata["config"]
    preset = {"name": "repeat", "description": f"Trains {source.run} again.", "train": [source.run],
              "runs": {source.run: {"base": source.base, **config}}}  # fmt: skip
    needed = [f"`{config[key]}`" for key in ("lights", "normals") if config.get(key) not in (None, "", TRUE_LIGHTS)]
    first = f" It needs {' and '.join(needed)} in `OUT/models`, and trains what is missing first." if needed else ""
    text = yaml.safe_dump(preset, sort_keys=False, width=120)
    return (
        f"## How to repeat it\n\nSave this as `repeat.yaml` and run `sdps train --preset repeat.yaml --data DATA --out "
        f"OUT`, with the data folder above as DATA.{first}\n\n```yaml\n{text}```\n"
    )


def _repeat_all(source: _Sources) -> str:
    """Give the preset that was trained with, for data, this run, and those whose weights it needs."""
    kept = {name: value for name, value in source.preset.items() if name != "test"}
    preset = {**kept, "name": "repeat", "description": f"Trains {source.run} again.", "train": [source.run]}
    text = yaml.safe_dump(preset, sort_keys=False, width=120)
    return (
        "## How to repeat it\n\nSave this as `repeat.yaml`; it is the preset "
        f"`{source.preset.get('name', UNKNOWN)}` with all settings as they were. `sdps render-data --preset "
        "repeat.yaml --out OUT` makes the data again, `sdps train --preset repeat.yaml --out OUT` trains this run, "
        f"after those whose weights it needs.\n\n```yaml\n{text}```\n"
    )


def _load(source: _Sources) -> str:
    """Give a Python snippet that uses the weights."""
    role, entry = source.model.role, registry.entry(source.model.name)
    files = {
        "lighting": (f'lighting="{source.file}", normals="nenet.safetensors"', ""),
        "second": (f'lighting="{entry.lights}.safetensors", '
                   f'normals="{entry.normals}.safetensors", second="{source.file}"', ""),
        "normals": (f'lighting="lcnet.safetensors", normals="{source.file}"', ", lights, intensities"),
        "pixels": (f'lighting="lcnet.safetensors", normals="{source.file}"', ", lights, intensities"),
    }  # fmt: skip
    arguments, known = files[role]
    note = "  # leave lights, intensities out to have them estimated" if known else ""
    if role in ("normals", "pixels") and not getattr(source.model.network, "needs_lights", role == "pixels"):
        arguments, known, note = f'normals="{source.file}"', "", ""
    return f"""## How to load it

```python
from sdps.inference import load_estimator

estimator = load_estimator({arguments})
# images (L, H, W, 3) float, linear; mask (H, W) bool
estimate = estimator.estimate(images, mask{known}){note}
```
"""


def _metrics(source: _Sources) -> dict[str, float]:
    """Return the validation figures of the weights by name, without `val_`."""
    recorded = source.model.metadata.get("metrics") or {}
    return {name.removeprefix("val_"): float(value) for name, value in recorded.items()}


def _best(rows: Rows, name: str) -> str:
    values = [(row[f"val_{name}"], row["step"]) for row in rows if f"val_{name}" in row]
    return "{:.4g} at step {:,}".format(*min(values)) if values else UNKNOWN


def _mean(rows: Rows, name: str, form: str) -> str:
    values = [row[name] for row in rows if name in row]
    return form.format(sum(values) / len(values)) if values else UNKNOWN


def _last(rows: Rows, name: str) -> str:
    values = [row[name] for row in rows if name in row]
    return f"{values[-1]:.4g}" if values else UNKNOWN


def _flat(values: Mapping[str, Any], prefix: str = "") -> Iterable[tuple[str, Any]]:
    """Yield dotted names and values of nested settings."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _flat(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _value(value: Any) -> str:
    """Spell a setting, or the facts about another model."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_value(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return ", ".join(map(_value, value)) or "none"
    if value is None:
        return "not set"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value) or "empty"


def _computed(metadata: Mapping[str, Any]) -> str:
    """Spell what the steps were computed in."""
    parts = metadata.get("computed")
    return "; ".join(f"{p['precision']} on {p['device']} from step {p['step']}" for p in parts) if parts else UNKNOWN


def _counts(counts: Mapping[Any, int]) -> str:
    """Spell counts: the value alone when there is one, else each with its number of scenes."""
    ordered = sorted(counts.items(), key=lambda item: -item[1])
    if len(ordered) == 1:
        return f"{ordered[0][0]} ({ordered[0][1]:,})"
    return f"{sum(counts.values()):,}: " + ", ".join(f"{value} {count:,}" for value, count in ordered)
