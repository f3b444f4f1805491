"""The model card: one Markdown page about trained weights, with front matter as model hubs read it.

Everything on it comes from the weights' metadata, the registry, the run's metrics and the data folder's manifest. What
is in none of them is "not recorded".
"""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any

from render.records.manifest import MANIFEST, SceneSpec, read_manifest
from render.records.shards import file_hash
from render.shared.config import read_yaml
from render.shared.decoding import decoding
from render.shared.errors import InputError
from render.shared.files import read_text, write_text
from render.shared.templates import fill
from sdps.models import registry
from sdps.models.blocks import parameter_count
from sdps.models.checkpoint import TrainedModel, load_weights
from sdps.models.registry import TRUE_LIGHTS
from sdps.publishing.learning_curves import Rows, read_metrics
from sdps.training.recipes import CONFIGS

UNKNOWN = "not recorded"
_METRICS, _DATASET_CARD = "metrics.jsonl", "DATASET_CARD.md"
_PRESET, _TRAINING = "config.yaml", "training.yaml"  # what `sdps train` leaves next to the weights
_LICENCES = re.compile(r"^## Licences\n(.*?)(?=^## |\Z)", re.DOTALL | re.MULTILINE)  # section of a dataset card
_OF_LIGHTS = ("direction_mae", "intensity_error")
_TEMPLATE = Path(__file__).with_name("model_card.md.j2")


@cache
def _words() -> dict[str, Any]:
    return read_yaml(str(resources.files("assets") / "model_card.yaml"))


def write_model_card(
    path: str | Path, weights: str | Path, data: str | Path | None = None, *, shipped: str | Path | None = None
) -> None:
    """Write the card of trained weights; metrics and configuration of the run are read from their folder.

    Args:
        path: The card, by convention `MODEL_CARD.md` next to the weights.
        weights: The safetensors file, in its run's folder.
        data: The data folder trained on, for its composition.
        shipped: A copy of the weights, rounded, that the card is to travel with.

    Raises:
        InputError: weights that cannot be loaded, a damaged manifest, or an unwritable disk.
    """
    write_text(path, render_card(weights, data, shipped))


def render_card(weights: str | Path, data: str | Path | None = None, shipped: str | Path | None = None) -> str:
    """Compose the card; see `write_model_card`."""
    model = load_weights(weights)
    with decoding(weights, "weights with the settings they were trained with", "train them again"):
        return _compose(model, Path(weights), data, shipped)


def _compose(model: TrainedModel, weights: Path, data: str | Path | None, shipped: str | Path | None) -> str:
    """Fill the template."""
    copy = Path(shipped or weights)
    metadata, config, entry = model.metadata, model.metadata["config"], registry.entry(model.name)
    metrics = weights.parent / _METRICS
    rows = read_metrics(metrics) if metrics.is_file() and metrics.stat().st_size else []
    folder = Path(data) if data is not None and (Path(data) / MANIFEST).is_file() else None
    card = read_text(folder / _DATASET_CARD) if folder is not None and (folder / _DATASET_CARD).is_file() else ""
    lights = metadata.get("lights") or entry.lights
    scores = _scores(metadata, lights_given=lights == TRUE_LIGHTS)
    composition = _data(model, folder)
    return fill(
        _TEMPLATE,
        unknown=UNKNOWN,
        head=_front_matter(model, copy.stem, scores, pretrained=shipped is not None),
        name=weights.stem,
        file=copy.name,
        size=f"{copy.stat().st_size / 1e6:.1f} MB as {'float32' if shipped is None else 'float16'}",
        model=model,
        network=model.network,
        entry=entry,
        gives=_words()["gives"][entry.role],
        parameters=parameter_count(model.network),
        lights=_words()["lights"].get(lights, f"those of `{lights}`"),
        options=_value(model.options),
        input=model.augmentation(),
        training=_training(metadata, rows),
        config=config,
        settings=[(f"`{name}`", _value(value)) for name, value in _flat(config)],
        data=composition,
        missing=", ".join(_missing(model)),
        data_card=card and "composition" not in dict(composition),
        scores=[(name, f"{value:.4g}", *_definition(name), _best(rows, name)) for name, value in scores.items()],
        pretrained=shipped is not None,
        data_terms="".join(_LICENCES.findall(card)).strip(),
        **_repeat(weights, model),
    )


def _missing(model: TrainedModel) -> Iterable[str]:
    """Yield what the images in training did not show; networks that may be told of near lamps learned from them."""
    network, seen = model.network, model.augmentation()
    if not (getattr(network, "sees_places", False) or getattr(network, "near", None) is not None):
        yield from ("near lights", "perspective")
    if seen.sensor is None:
        yield from ("ambient light", "the optics of real cameras")
    if seen.mixed is None:
        yield "several lights at once"


def _scores(metadata: Mapping[str, Any], *, lights_given: bool) -> dict[str, float]:
    """Return the metrics of validation, without the errors of lights that the network was given."""
    scores = {name.removeprefix("val_"): float(value) for name, value in (metadata.get("metrics") or {}).items()}
    return {name: value for name, value in scores.items() if not (lights_given and name.startswith(_OF_LIGHTS))}


def _repeat(weights: Path, model: TrainedModel) -> dict[str, Any]:
    """Return the preset that trains a run again, the name of the one it was trained with, and the runs it needs."""
    run, config = weights.absolute().parent.name, model.metadata["config"]
    again = {"name": "repeat", "description": f"Trains {run} again.", "train": [run]}
    recorded = _plain(weights.parent / _PRESET)
    if "data" in recorded:
        kept = {name: value for name, value in recorded.items() if name not in ("test", "joint")}
        return {"preset": {**kept, **again}, "recorded": recorded.get("name", UNKNOWN), "needed": []}
    base = _plain(weights.parent / _TRAINING).get("model") or model.name
    known = {field.name for field in fields(CONFIGS[model.role])}  # earlier versions had further settings
    settings = {name: value for name, value in config.items() if name in known}
    needed = [f"`{settings['lights']}`"] if settings.get("lights") not in (None, "", TRUE_LIGHTS) else []
    return {"preset": {**again, "runs": {run: {"base": str(base), **settings}}}, "recorded": "", "needed": needed}


def _plain(file: Path) -> dict[str, Any]:
    try:
        return read_yaml(file)
    except InputError:
        return {}


def _front_matter(model: TrainedModel, name: str, scores: Mapping[str, float], *, pretrained: bool) -> dict[str, Any]:
    licence = {"license_name": "terms-of-the-training-data"}
    if pretrained:
        licence = {"license_name": "research-use", "license_link": "LICENSE-DATA"}
    kind = "surface-normals" if "normal" in _words()["gives"][model.role] else "lighting"
    values: dict[str, Any] = {
        "library_name": "sdps",
        "license": "other",
        **licence,
        "pipeline_tag": "image-to-image",
        "tags": ["photometric-stereo", kind, "synthetic", model.name],
    }
    if scores:
        result = {
            "task": {"type": "image-to-image", "name": "uncalibrated photometric stereo"},
            "dataset": {
                "type": "rendered",
                "name": f"manifest {str(model.metadata.get('data', UNKNOWN))[:12]}",
                "split": "val",
            },
            "metrics": [{"type": key, "value": round(value, 4)} for key, value in scores.items()],
        }
        values["model-index"] = [{"name": name, "results": [result]}]
    return values


def _training(metadata: Mapping[str, Any], rows: Rows) -> list[tuple[str, str]]:
    """List what the weights and the metrics record of the run."""
    seconds, step = metadata.get("seconds"), metadata.get("step")
    parts = [f"{p['precision']} on {p['device']} from step {p['step']}" for p in metadata.get("computed") or ()]
    loss = [row["loss"] for row in rows if "loss" in row]
    facts = [
        ("optimiser steps", UNKNOWN if step is None else f"{step:,}"),
        ("hours", UNKNOWN if seconds is None else f"{seconds / 3600:.2f}"),
        ("computed in", "; ".join(parts) or UNKNOWN),
        ("images per second", _mean(rows, "images_per_second", "{:.0f}")),
        ("share of time waiting for data", _mean(rows, "waiting_share", "{:.1%}")),
        ("last training loss", f"{loss[-1]:.4g}" if loss else UNKNOWN),
        ("code version (hash of the package's source)", f"`{metadata.get('code', UNKNOWN)}`"),
    ]
    if isinstance(metadata.get("lighting"), Mapping):
        facts.append(("frozen lighting model it was trained with", _value(metadata["lighting"])))
    return facts


def _data(model: TrainedModel, folder: Path | None) -> list[tuple[str, Any]]:
    """List the composition of the data folder, if it is there and the one trained on."""
    digest, scenes = model.metadata.get("data"), model.metadata.get("scenes")
    rows: list[tuple[str, Any]] = [("SHA-256 of the manifest", f"`{digest}`" if digest else UNKNOWN)]
    if scenes is not None:
        rows.append(("scenes per epoch", f"{scenes:,}"))
    if folder is None:
        return [*rows, ("composition", UNKNOWN)]
    if digest and digest != file_hash(folder / MANIFEST):
        return [*rows, ("composition", f"{UNKNOWN}; the data folder given has another manifest now")]
    return [*rows, *_composition(read_manifest(folder))]


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


def _definition(name: str) -> tuple[str, str]:
    """Return unit and definition of a metric."""
    for key, (unit, text) in _words()["metrics"].items():
        if name.startswith(key):
            how = _words()["read_outs"].get(name.removeprefix(f"{key}_"))
            return unit or "-", f"{text}; {how}" if how else text
    return UNKNOWN, UNKNOWN


def _best(rows: Rows, name: str) -> str:
    values = [(row[f"val_{name}"], row["step"]) for row in rows if f"val_{name}" in row]
    return "{:.4g} at step {:,}".format(*min(values)) if values else UNKNOWN


def _mean(rows: Rows, name: str, form: str) -> str:
    values = [row[name] for row in rows if name in row]
    return form.format(sum(values) / len(values)) if values else UNKNOWN


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


def _counts(counts: Mapping[Any, int]) -> str:
    """Spell counts: the value alone when there is one, else each with its number of scenes."""
    ordered = sorted(counts.items(), key=lambda item: -item[1])
    if len(ordered) == 1:
        return f"{ordered[0][0]} ({ordered[0][1]:,})"
    return f"{sum(counts.values()):,}: " + ", ".join(f"{value} {count:,}" for value, count in ordered)
