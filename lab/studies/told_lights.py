"""What wrong lights cost a normal network: it is told the found ones, and truer and truer ones.

    python -m lab.studies.told_lights DATA --preset anylight --run frames-any
    python -m lab.studies.told_lights DATA --preset anylight --run frames-any --models OUT

Scenes of the split `val`, with the lights, the draws and the images that the run is validated on.
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional

from lab.studies.seen_and_unseen import build_stage, read_arguments, read_scenes
from pipelines.shared.text_tables import render_text
from sdps.core.precision import arithmetic
from sdps.data.dataset import Batch, SampleOptions
from sdps.models.base import Lights
from sdps.training.stages import NormalStage, normal_error, placed, true_lights


def tell(found: Lights, batch: Batch) -> dict[str, Lights]:
    """Return what the network is told of the lights, from those found to the true ones."""
    true = true_lights(batch)
    bend = torch.linalg.lstsq(found.directions.float(), true.directions).solution  # (B, 3, 3)
    bent = functional.normalize(found.directions.float() @ bend, dim=-1)
    return {
        "found": found,
        "found, moved by the best linear map": found._replace(directions=bent),
        "true directions": found._replace(directions=true.directions),
        "and intensities": found._replace(directions=true.directions, intensities=true.intensities),
        "and nearness and covariance": true._replace(expected_error=found.expected_error),
        "and that they are exact": true,
    }


def measure(stage: NormalStage, data: Path, count: int, options: SampleOptions) -> dict[str, float]:
    """Return the mean errors of so many scenes, in degrees, by what is told of the lights."""
    errors: dict[str, list[float]] = {}
    with torch.no_grad(), arithmetic(stage.config.precision, torch.device("cpu")).autocast():
        for batch in read_scenes(data, "val", count, options):
            found = stage.lights(batch)
            assert found is not None  # the network is given lights
            for name, lights in tell(found, batch).items():
                seen = stage.network.observe(batch.images, batch.mask, lights, placement=placed(batch))
                errors.setdefault(name, []).append(normal_error(stage.network(seen), batch))
    return {name: float(np.mean(values)) for name, values in errors.items()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, and print the table."""
    args = read_arguments(arguments, __doc__, 48)
    stage = build_stage(args.preset, args.run, args.models)
    assert isinstance(stage, NormalStage)
    stage.network.eval()
    columns = {suffix.strip("_") or "all": measure(stage, args.data, args.scenes, options)
               for suffix, options in stage.validations().items()}  # fmt: skip
    told = next(iter(columns.values()))
    lines = [[name, *(f"{column[name]:.2f}" for column in columns.values())] for name in told]
    sys.stdout.write(render_text("Mean error, degrees", ["told", *columns], lines))
    return 0


if __name__ == "__main__":
    sys.exit(main())
