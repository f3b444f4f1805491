"""The light of a training sample's images, drawn together, from stages and from any lights."""

import numpy as np
import pytest

from render.planning import light_sets
from render.shared.errors import InputError
from render.shared.imaging.mixing import LightMix, LightStage
from render.shared.imaging.scene_mixing import SceneMix
from render.shared.seeds import generator

FEW = LightStage(light_sets.load("stage:16"), "test", sparse=True)
DENSE = LightStage(light_sets.load("stage:256"), "test")


def kinds(recipes: list[dict]) -> list[set[str]]:
    return [{light["kind"] for light in recipe["lights"]} for recipe in recipes]


def test_a_few_lights_are_refused_unless_asked_for():
    with pytest.raises(InputError, match="16 lights are too few"):
        LightStage(FEW.directions, "test")


def test_by_default_light_is_drawn_as_for_each_image():
    one = SceneMix().draw(DENSE, 5, generator(1))[0]
    np.testing.assert_array_equal(one, LightMix().draw(DENSE, 5, generator(1))[0])


def test_single_lights_are_those_of_the_scene_each_once():
    weights, recipes = SceneMix(sparse=True, single=1.0).draw(FEW, 16, generator(2))
    assert (weights.max(1) == 1.0).all() and (weights.sum(1) == 1.0).all()
    np.testing.assert_array_equal(weights.sum(0), 1.0)
    assert all(each == {"single"} for each in kinds(recipes))
    again, _ = SceneMix(sparse=True, single=1.0).draw(FEW, 20, generator(2))
    assert again.shape == (20, 16, 3)


def test_surroundings_alone_and_a_room_that_stays():
    weights, recipes = SceneMix(sparse=True, surrounded=1.0).draw(FEW, 6, generator(3))
    assert all(each == {"environment"} for each in kinds(recipes))
    np.testing.assert_allclose(weights.mean(2).sum(1), 1.0, rtol=1e-5)
    assert np.abs(weights[0] - weights[1]).max() > 0.01
    weights, recipes = SceneMix(sparse=True, steady=1.0, environments=("room:3",)).draw(FEW, 6, generator(4))
    assert all("environment" in each and len(each) > 1 for each in kinds(recipes))
    assert len({light["share"] for recipe in recipes for light in recipe["lights"][-1:]}) == 1
    np.testing.assert_allclose(weights.mean(2).sum(1), 1.0, rtol=1e-5)
    shares = weights / weights.sum(1, keepdims=True)
    assert (shares.min(0) > 0.001).mean() > 0.5  # the room reaches every image from most sides


def test_shares_are_drawn_as_often_as_they_say():
    mix, rng = SceneMix(sparse=True, single=0.3, surrounded=0.3), generator(5)
    drawn = [kinds(mix.draw(FEW, 2, rng)[1])[0] for _ in range(300)]
    assert 0.2 < np.mean([each == {"single"} for each in drawn]) < 0.4
    assert 0.25 < np.mean([each == {"environment"} for each in drawn]) < 0.6  # some mixtures are no more


def test_shares_beyond_all_are_refused():
    for wrong in ({"single": 0.7, "surrounded": 0.5}, {"steady": 1.5}):
        with pytest.raises(InputError, match="must add up to 1 at most"):
            SceneMix(**wrong)
    with pytest.raises(InputError, match="single"):
        SceneMix(single=-0.1)
    with pytest.raises(InputError, match="environments must name a map"):
        SceneMix(environments=(), environment=0.0, steady=0.5)
