"""What the model of refinement leaves of a material."""

import numpy as np
import pytest

from lab.studies import reflectance_modes as study
from render.materials.fit.spheres import hemisphere_lights
from render.materials.library import load


def test_nothing_is_left_of_a_matte_material_and_much_of_what_changes_colour(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "_SIDE", 14)
    monkeypatch.setattr(study, "_ITERATIONS", 120)
    lights = hemisphere_lights(30, np.random.default_rng(0)).astype(np.float32)
    matte, changing, felt = (
        study.measure_left(load(name), lights)
        for name in ("lambertian:0.5/0.3/0.2", "color-changing-paint1", "pink-felt")
    )
    assert max(matte.grey, abs(matte.grazing), matte.colour) < 0.01
    assert changing.colour > 0.05 and felt.grazing > 0.05
