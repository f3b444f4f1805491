"""Join what a network and refinement found of an object into one answer."""

from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import load_file

from render.shared.decoding import decoding
from render.shared.progress import stage
from sdps.core.metrics import angle_degrees
from sdps.inference.tiles import release_memory, tiles
from sdps.methods.fusion.evidence import Evidence, find_place
from sdps.methods.fusion.network import MULTIPLE, REACH, FusionNet, describe, prepare_part
from sdps.models.blocks import chord_degrees
from sdps.refinement.trust import RefinedEstimate

TILE_PIXELS = 2**19
"""Pixels that are joined at once, at about 1.1 kB each."""
WEIGHTS = Path(str(resources.files("assets"))) / "fusion.safetensors"


@dataclass(frozen=True, kw_only=True, eq=False)
class FusedEstimate(RefinedEstimate):
    """An estimate whose normals, and the errors to expect of them, are joined of a network's and of refinement's.

    Attributes:
        moved: Mean angles in degrees to the network's normals under refined lights, and to the refined ones.
    """

    moved: tuple[float, float]


def fuse(refined: RefinedEstimate, evidence: Evidence, mask: np.ndarray) -> FusedEstimate:
    """Return the joined answer; arguments: the estimate, what is known of it, and its mask (H, W) bool."""
    normals, expected = join(evidence, load_fusion())
    whole, errors = np.zeros((*mask.shape, 3), np.float32), np.zeros(mask.shape, np.float32)
    box = find_place(mask)
    whole[box], errors[box] = normals, expected
    inside = evidence.mask
    from_network, from_refined = (
        float(angle_degrees(normals[inside], each[inside]).mean()) for each in (evidence.network, evidence.refined)
    )
    values = vars(refined) | {"normals": whole, "expected_error": errors}
    return FusedEstimate(**values, moved=(from_network, from_refined))


@torch.inference_mode()
def join(evidence: Evidence, network: FusionNet) -> tuple[np.ndarray, np.ndarray]:
    """Return normals (h, w, 3) float32 unit, and degrees to expect (h, w) float32, zero outside the mask."""
    mask = evidence.mask
    normals, degrees = np.zeros((*mask.shape, 3), np.float32), np.zeros(mask.shape, np.float32)
    parts, numbers = tiles(mask, TILE_PIXELS, REACH, MULTIPLE), describe(evidence)
    for number, tile in enumerate(parts, start=1):
        found = network(prepare_part(evidence.part(tile.outer_rows, tile.outer_columns), numbers))
        normals[tile.inner] = found.normals[0].permute(1, 2, 0).numpy()[tile.within]
        degrees[tile.inner] = chord_degrees(found.expected)[0, 0].numpy()[tile.within]
        stage("fusion", number, len(parts))
        if len(parts) > 1:
            del found
            release_memory()
    return normals * mask[..., None], degrees * mask


@cache
def load_fusion(file: Path = WEIGHTS) -> FusionNet:
    """Return the network with its weights, those shipped with the package.

    Raises:
        InputError: they are missing or damaged.
    """
    network = FusionNet().eval()
    with decoding(file, "a safetensors file", "install the package again"):
        network.load_state_dict({name: value.float() for name, value in load_file(file).items()})
    return network
