"""Which side of a relief is up: told by cast shadows and by near lamps, and by nothing else."""

from dataclasses import replace

import numpy as np
import pytest

from lab.studies import flat_study
from lab.studies.flat_study import Flat, photograph
from sdps.api import _tell_flat
from sdps.core.estimate import Estimate
from sdps.core.metrics import normal_mae
from sdps.methods.flat_things import Flatness, turn_inside_out
from sdps.methods.relief_sides import Evidence, tell_side

SIDE = 96
WHOLE = np.ones((SIDE, SIDE), bool)


def truth(made: Flat) -> Estimate:
    return Estimate(made.normals, made.lights, made.gains)


def steep(depth: float, seed: int = 0) -> Flat:
    """Return a coin that casts shadows."""
    return photograph("coin", SIDE, 8, depth=depth, seed=seed, slant=75.0)


@pytest.mark.parametrize("depth", [4.0, -4.0])
def test_shadows_tell_the_side(depth: float) -> None:
    made = steep(depth)
    right, wrong = truth(made), turn_inside_out(truth(made))
    for found, side in ((right, 1), (wrong, -1)):
        told = tell_side(made.images, WHOLE, found)
        assert (told.side, told.by) == (side, "shadows")


@pytest.mark.parametrize("kind", ["weave", "paint"])
def test_near_lamps_tell_the_side(kind: str) -> None:
    made = photograph(kind, SIDE, 12, distance=1.5, depth=0.4)
    right, wrong = truth(made), turn_inside_out(truth(made))
    for found, side in ((right, 1), (wrong, -1)):
        told = tell_side(made.images, WHOLE, found)
        assert (told.side, told.by) == (side, "near lamps")


@pytest.mark.parametrize("bowl", [0.0, 0.35, -0.35])
def test_distant_lamps_without_shadows_tell_nothing(monkeypatch: pytest.MonkeyPatch, bowl: float) -> None:
    """Nor do bowls and domes pass for near lamps, which brighten pictures towards the lamp, too."""
    make = flat_study._make

    def bend(kind: str, side: int, rng: np.random.Generator) -> tuple:
        heights, *rest = make(kind, side, rng)
        y, x = np.mgrid[-1 : 1 : side * 1j, -1 : 1 : side * 1j]
        return heights + bowl * side / 4 * (x**2 + y**2), *rest

    monkeypatch.setattr(flat_study, "_make", bend)
    made = photograph("weave", SIDE, 12, depth=0.4 if not bowl else 1.0)
    assert tell_side(made.images, WHOLE, truth(made)) == (0.0, 0.0)


def test_what_contradicts_itself_tells_nothing() -> None:
    assert Evidence(0.5, -0.5).side == 0 and Evidence(0.0, 0.0).by == ""
    assert Evidence(-0.5, -0.4).side == -1 and Evidence(-0.5, -0.4).by == "shadows and near lamps"


def test_a_mask_and_stray_light_are_kept_to() -> None:
    made = steep(4.0)
    mask, images = WHOLE.copy(), made.images + 0.2
    mask[:, :12] = False
    images[:, ~mask] = 0.0
    found = truth(made)
    found = replace(found, normals=found.normals * mask[..., None], stray_light=np.full((8, 3), 0.2, np.float32))
    assert tell_side(images, mask, found).side == 1


def test_what_was_found_inside_out_is_turned() -> None:
    made = steep(4.0)
    wrong = turn_inside_out(truth(made))
    found = Flatness("yes").begin(wrong, WHOLE, lit=False, images=made.images)
    assert normal_mae(found.normals, made.normals, WHOLE) < 1.0 and found.side_by == "shadows"
    turned = Flatness("turned").begin(wrong, WHOLE, lit=False, images=made.images)
    assert normal_mae(turned.normals, wrong.normals, WHOLE) < 1.0
    given = Flatness("yes").begin(wrong, WHOLE, lit=True, images=made.images)
    np.testing.assert_array_equal(given.light_directions, wrong.light_directions)


def test_people_are_told_what_tells_the_side() -> None:
    found = replace(truth(steep(4.0)), tilt=3.0)
    said = [
        next(_tell_flat(estimate, Flatness(wish), lit=lit)).text
        for estimate, wish, lit in (
            (replace(found, side_by="shadows"), "auto", False), (found, "auto", False), (found, "turned", False),
            (found, "yes", True),
        )
    ]  # fmt: skip
    assert "which are hollow is told by shadows" in said[0] and "--flat turned" not in said[0]
    assert "Nothing tells which parts stand out" in said[1] and "--flat turned if it is inside out" in said[1]
    assert "turned to be hollow, as asked" in said[2] and "hollow" not in said[3]
    assert not list(_tell_flat(replace(found, tilt=None), Flatness(), lit=False))
