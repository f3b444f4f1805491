"""Weights as safetensors with what is needed to use them, and trainer state to go on from.

Neither file can execute code when loaded, and neither is ever half-written.
"""

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import torch
from safetensors import safe_open
from safetensors.torch import save
from torch import nn

from render.shared.config import build
from render.shared.decoding import decoding
from render.shared.errors import InputError
from render.shared.files import atomic_path, parse_json, source_digest
from sdps.data.augment import Augmentation
from sdps.models import registry

FORMAT = "sdps-weights-1"

_LENGTH = struct.Struct("<Q")
"""The first bytes of a safetensors file: the length of its header, which is JSON."""


@dataclass(frozen=True, eq=False)
class TrainedModel:
    """A network with its weights and where they come from.

    Attributes:
        name: Name in `sdps.models.registry` (several runs may train one model).
        network: The network, in eval mode, weights float32.
        options: Options it was built with.
        metadata: `config` (the training section as plain values), `data` (SHA-256 of the manifest),
            `code` (hash of this package), `step`, and the final validation `metrics`.
    """

    name: str
    network: nn.Module
    options: dict[str, Any]
    metadata: dict[str, Any]

    @property
    def role(self) -> registry.Role:
        """What the model is for; see `registry.ModelEntry`."""
        return registry.entry(self.name).role

    def augmentation(self) -> Augmentation:
        """Return the augmentation of training, whose exposure test images must be brought to."""
        return build(Augmentation, self.metadata["config"]["augmentation"], "augmentation")


@cache
def code_version() -> str:
    """Return a short hash of this package's source files."""
    return source_digest(Path(__file__).parents[1])


def save_weights(path: str | Path, model: TrainedModel, *, half: bool = False) -> None:
    """Write the network's weights and metadata atomically; the same model gives the same bytes.

    Args:
        path: Destination, by convention `.safetensors`.
        model: What to save.
        half: Store float16, half the size, to be read back as float32.
    """
    dtype = torch.float16 if half else torch.float32
    tensors = {
        name: tensor.detach().to("cpu", dtype).contiguous() for name, tensor in model.network.state_dict().items()
    }
    header = {"format": FORMAT, "model": model.name, "options": json.dumps(model.options)}
    header["metadata"] = json.dumps(model.metadata)
    with atomic_path(path) as temporary:
        temporary.write_bytes(_with_sorted_header(save(tensors, metadata=header)))


def _with_sorted_header(data: bytes) -> bytes:
    """Return a safetensors file with the keys of its header in order; the library leaves them to chance."""
    start = _LENGTH.size + _LENGTH.unpack_from(data)[0]
    header = json.loads(data[_LENGTH.size : start])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, ensure_ascii=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % _LENGTH.size)  # tensors stay aligned
    return _LENGTH.pack(len(text)) + text + data[start:]


def load_weights(path: str | Path) -> TrainedModel:
    """Read weights written by `save_weights` and build their network. Runs no code from the file.

    Raises:
        InputError: missing, truncated or foreign file, an unknown model, or weights that do not fit it.
    """
    if not Path(path).is_file():
        raise InputError(f"{path}: no such weights file; train one or give another path")
    with decoding(path, "a safetensors file", "copy or train it again"), safe_open(path, framework="pt") as file:
        header = file.metadata() or {}
        tensors = {name: file.get_tensor(name).float() for name in file.keys()}  # noqa: SIM118 (not a dict)
    if header.get("format") != FORMAT:
        raise InputError(f"{path}: not written by this project (no {FORMAT!r} header); train the network again")
    name, options, metadata = _read_header(path, header)
    damaged = next((key for key, tensor in tensors.items() if not torch.isfinite(tensor).all()), None)
    if damaged is not None:
        raise InputError(f"{path}: {damaged} has values that are infinite or NaN; copy or train it again")
    try:
        with torch.device("meta"):  # shapes only: options may ask for terabytes
            wanted = registry.create(name, **options).state_dict()
    except Exception as error:  # whatever a network's layers raise at values of any kind
        raise InputError(f"{path}: damaged header ({error}); copy or train it again") from error
    misfit = next((key for key in wanted.keys() | tensors.keys() if _shape(wanted, key) != _shape(tensors, key)), None)
    if misfit is not None:
        detail = f"{misfit}: {_shape(tensors, misfit)}, not {_shape(wanted, misfit)}"
        raise InputError(f"{path}: weights do not fit {name!r} ({detail}); train it again")
    network = registry.create(name, **options)
    network.load_state_dict(tensors)
    return TrainedModel(name, network.eval(), options, metadata)


def _shape(tensors: Mapping[str, torch.Tensor], name: str) -> tuple[int, ...] | None:
    return tuple(tensors[name].shape) if name in tensors else None


def _read_header(path: str | Path, header: dict[str, str]) -> tuple[str, dict[str, Any], dict[str, Any]]:
    """Return model name, options and metadata of a file's header, or refuse it."""
    try:
        name, options, metadata = header["model"], parse_json(header["options"]), parse_json(header["metadata"])
        if not isinstance(options, dict):
            raise TypeError("options: must be a mapping")
        build(Augmentation, metadata["config"]["augmentation"], "augmentation")
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: damaged header ({error}); copy or train it again") from error
    if name not in registry.MODELS:
        raise InputError(f"{path}: holds {name!r}, a model this version does not know; see `sdps models`")
    return name, options, metadata


def save_state(path: str | Path, state: dict[str, Any]) -> None:
    """Write trainer state (tensors, numbers, text, and containers of these) atomically."""
    with atomic_path(path) as temporary:
        torch.save(state, temporary)


def load_state(path: str | Path) -> dict[str, Any]:
    """Read trainer state without executing anything in it.

    Raises:
        InputError: truncated or foreign file.
    """
    with decoding(path, "a checkpoint", "delete it to start this run again"):
        state = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(state, dict):
            raise TypeError(f"it holds a {type(state).__name__}")
        return state
