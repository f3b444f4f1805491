"""What people are told of how far away the lamps stood."""

import json

import numpy as np
import pytest

from sdps.surface.lamp_distance import describe_lamps, measure_distances


@pytest.mark.parametrize(
    ("nearness", "origin", "size", "said"),
    [
        (None, "assumed", None, "the lamps were taken for far away"),
        (None, "found", 80.0, "the lamps stood far away, over 50 object sizes"),
        ([0.0, 0.0], "given", None, "the lamps stood far away, as given"),
        ([0.009, 0.009], "found", None, "the lamps stood far away, over 50 object sizes"),
        ([0.102, 0.102], "found", None, "the lamps stood about 4.9 object sizes away"),
        ([0.1, 0.1], "given", 80.0, "the lamps stood about 5 object sizes (400 mm) away, as given"),
        ([0.5, 0.5], "found", None, "the lamps stood about 1 object size away"),
        ([0.25, 0.1, 0.05], "found", None, "the lamps stood about 5 object sizes away, the nearest 2, the furthest 10"),
        ([0.1, 0.1, 0.0], "given", None, "the lamps stood about 5 object sizes away, and 1 far away, as given"),
        ([0.1, 0.102], "found", 256.0, "the lamps stood about 5 object sizes (1300 mm) away"),
    ],
)
def test_the_sentence(nearness, origin, size, said) -> None:
    given = None if nearness is None else np.array(nearness, np.float32)
    facts = describe_lamps(measure_distances(given, 2 if given is None else len(given)), origin, size)
    assert facts["text"] == said and facts["origin"] == origin
    assert facts["far"] == ("distance_in_object_sizes" not in facts) == ("about" not in said)
    json.dumps(facts, allow_nan=False)


def test_the_numbers() -> None:
    distances = measure_distances(np.array([0.25, 0.1, 0.05, 0.001], np.float32), 4)
    assert distances == pytest.approx([2.0, 5.0, 10.0, np.inf])
    facts = describe_lamps(distances, "found", 80.0)
    del facts["text"]
    assert facts == {
        "origin": "found", "far": False, "distance_in_object_sizes": 5.0, "distance_in_millimetres": 400.0,
        "nearest": 2.0, "furthest": 10.0, "far_lamps": 1,
    }  # fmt: skip
