"""Light intensities: one meaning at every door."""

import numpy as np
import pytest

from render.shared.errors import InputError
from sdps.core.intensities import check_intensities, colour_balance, grey, over_first, per_channel, scale_to_mean

COLOURED = np.array([[1.0, 2.0, 3.0], [4.0, 2.0, 3.0]])


def test_grey_is_the_mean_of_the_channels() -> None:
    np.testing.assert_array_equal(grey(COLOURED), [2.0, 3.0])
    np.testing.assert_array_equal(grey(np.array([0.5, 2.0])), [0.5, 2.0])


def test_only_ratios_mean_something() -> None:
    for values in (COLOURED, COLOURED[:, 0]):
        scaled = scale_to_mean(values, 1.1)
        assert scaled.mean() == pytest.approx(1.1)
        np.testing.assert_allclose(scale_to_mean(7.0 * values, 1.1), scaled)
        np.testing.assert_allclose(over_first(7.0 * values), over_first(values), rtol=1e-7)
    np.testing.assert_array_equal(scale_to_mean(np.zeros(3)), np.zeros(3))


def test_a_light_is_its_grey_times_its_colour() -> None:
    balance = colour_balance(COLOURED)
    assert balance is not None
    np.testing.assert_allclose(balance * grey(COLOURED)[:, None], COLOURED)
    assert colour_balance(COLOURED[:, 0]) is None


def test_every_channel_has_an_intensity() -> None:
    np.testing.assert_array_equal(per_channel(np.array([1.0, 2.0])), [[1.0] * 3, [2.0] * 3])
    np.testing.assert_array_equal(per_channel(COLOURED), COLOURED)


@pytest.mark.parametrize("wrong", [np.ones(3), np.ones((2, 2)), np.array([1.0, 0.0]), np.array([1.0, np.nan])])
def test_what_cannot_be_intensities_is_refused(wrong: np.ndarray) -> None:
    with pytest.raises(InputError, match="intensities"):
        check_intensities(2, wrong)
    check_intensities(2, COLOURED)
