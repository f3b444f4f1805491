"""Pictures of known values."""

import numpy as np

from pipelines.shared import pictures


def test_pictures_of_known_values():
    normals = np.zeros((2, 2, 3), np.float32)
    normals[0, 0] = 0, 0, 1
    mask = np.array([[True, False], [False, False]])
    picture = pictures.normal_map(normals, mask)
    assert picture[0, 0].tolist() == [128, 128, 255] and picture[1, 1].tolist() == [255, 255, 255]
    assert pictures.tone_map(np.array([[[0.0, 1.0, 0.2140]]])).tolist() == [[[0, 255, 127]]]
    errors = pictures.error_map(np.array([[0.0, np.nan]]))
    assert errors[0, 0].sum() < 10 and errors[0, 1].tolist() == [255, 255, 255]
