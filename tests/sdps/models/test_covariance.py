"""Covariances of light as six numbers: there and back, and turned."""

import torch

from sdps.models.covariance import pack, turn, unpack


def test_six_numbers_make_a_covariance_and_turn_as_it_does() -> None:
    torch.manual_seed(0)
    factors = torch.randn(5, 7, 3, 3)
    matrices = factors @ factors.transpose(-1, -2)
    rotations = torch.linalg.qr(torch.randn(5, 3, 3))[0]
    assert torch.equal(unpack(pack(matrices)), matrices)
    expected = rotations[:, None] @ matrices @ rotations.transpose(1, 2)[:, None]
    torch.testing.assert_close(unpack(turn(pack(matrices), rotations)), expected)
