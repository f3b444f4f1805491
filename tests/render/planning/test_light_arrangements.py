"""Rigs and hand-held lamps: as many lights as asked for, where their names say, the same for the same seed."""

import numpy as np
import pytest

from render.planning import arrangements, light_sets
from render.planning.plan import DataConfig, plan
from render.shared.seeds import generator

KINDS = ("grid", "rings", "dome", "hand-held", "stage")


def sets(kind: str, count: int = 96, number: int = 50) -> list[np.ndarray]:
    return [light_sets.draw(kind, count, generator(1, kind, seed)) for seed in range(number)]


def from_axis(vectors: np.ndarray) -> np.ndarray:
    return np.degrees(np.arccos(vectors[:, 2]))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [1, 2, 3, 7, 97])
def test_any_count_gives_unit_vectors_above_the_horizon(kind, count):
    for seed in range(20):
        vectors = light_sets.draw(kind, count, generator(seed, kind))
        assert vectors.shape == (count, 3) and (vectors.round(6)[:, 2] > 0).all()
        np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1, atol=1e-12)
        assert np.array_equal(vectors, light_sets.draw(kind, count, generator(seed, kind)))


def test_grids_are_narrow_even_and_differ():
    edges, spacings = [], []
    for vectors in sets("grid"):
        edges.append(from_axis(vectors).max())
        board = vectors[:, :2] / vectors[:, 2:]
        distance = np.linalg.norm(board[:, None] - board[None], axis=-1) + 10 * np.eye(96)
        nearest = distance.min(1)
        spacings.append(nearest.std() / nearest.mean())
    assert max(edges) <= 45.0 + 1e-9 and min(edges) >= 35.0 - 1e-9 and np.ptp(edges) > 5
    assert max(spacings) < 0.2  # a board: neighbours are about equally far


def test_rings_have_few_heights_and_even_spacing():
    numbers = set()
    for vectors in sets("rings"):
        heights = np.unique(from_axis(vectors).round(6))
        numbers.add(len(heights))
        assert heights.min() >= 15 and heights.max() <= 75
        ring = vectors[np.isclose(from_axis(vectors), heights[-1], atol=1e-5)]
        turn = np.sort(np.degrees(np.arctan2(ring[:, 1], ring[:, 0])))
        np.testing.assert_allclose(np.diff(turn), 360 / len(ring), atol=1e-6)
    assert numbers == {1, 2, 3}


def test_domes_are_even_out_to_their_edge():
    for vectors in sets("dome", 200, 10):
        cosine = np.clip(vectors @ vectors.T - 2 * np.eye(200), -1, 1)
        nearest = np.degrees(np.arccos(cosine.max(1)))
        assert nearest.std() / nearest.mean() < 0.15
        assert 55 < from_axis(vectors).max() < 90


def test_a_stage_divides_the_hemisphere_equally():
    dense = light_sets.draw("stage", 40_000, generator(0))
    for count in (128, 256, 512):
        vectors = light_sets.draw("stage", count, generator(5))
        owner = (dense @ vectors.T).argmax(1)
        share = np.bincount(owner, minlength=count) / len(dense) * count
        assert abs(share.mean() - 1) < 1e-9 and share.std() < 0.12
        assert np.abs(vectors.mean(0) - [0, 0, 0.5]).max() < 0.01  # as of the hemisphere itself
        # Lambert's cosine: white facing the camera under a constant hemisphere of radiance 1 has irradiance pi.
        assert vectors[:, 2].sum() * 2 * np.pi / count == pytest.approx(np.pi, rel=1e-6)


def test_a_hand_moves_smoothly_around():
    turns = []
    for vectors in sets("hand-held"):
        steps = np.degrees(np.arccos(np.clip((vectors[1:] * vectors[:-1]).sum(1), -1, 1)))
        assert steps.max() < 25 and from_axis(vectors).max() <= 80 + 1e-9
        second = np.linalg.norm(np.diff(vectors, 2, axis=0), axis=1)
        assert second.max() < 0.15  # no jump in speed
        turns.append(np.unwrap(np.arctan2(vectors[:, 1], vectors[:, 0])))
    around = np.array([turn[-1] - turn[0] for turn in turns]) / (2 * np.pi)
    assert np.abs(around).max() > 2 and (around > 0).any() and (around < 0).any()


def test_presets_and_names_take_them():
    config = DataConfig(families={"blobby": 1}, views=2, lights="hand-held", light_count=20, materials_per_view=1)
    first, second = plan(config)
    assert first.lights != second.lights and len(first.lights) == 20
    for kind in KINDS:
        assert np.array_equal(light_sets.load(f"{kind}:96"), light_sets.load(f"{kind}:96"))
    assert len(light_sets.load("grid:96")) == 96 and arrangements.GRID_EDGE[1] == 45
