"""Photographs that are mixed: single ones stay, and mixtures are of so many."""

import numpy as np

from lab.studies.mixed_photographs import mix


def test_single_pictures_are_photographs_and_mixed_ones_their_weighted_means():
    images = np.eye(6, dtype=np.float32)[:, None, :, None] * np.ones(3, np.float32)  # (6, 1, 6, 3): each lights a pixel
    single = mix(images, 4, 1, "cow")
    assert single.shape == (4, 1, 6, 3) and (single.sum(axis=(1, 2)) == 1.0).all()
    assert len(np.unique(single.reshape(4, -1), axis=0)) == 4, "each once"
    triples = mix(images, 5, 3, "cow")
    assert ((triples > 0).sum(axis=2) == 3).all() and (triples.sum(axis=2) < 1.5).all()
    assert (mix(images, 5, 3, "cow") == triples).all() and not (mix(images, 5, 3, "pot2") == triples).all()
