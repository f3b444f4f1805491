"""Muon: momentum whose update is made orthogonal, for the matrices of a network, with AdamW for everything else.

Jordan et al., "Muon: An optimizer for hidden layers in neural networks" (2024); the scale of the update is that of Liu
et al., "Muon is Scalable for LLM Training" (2025), so that learning rates of AdamW can be kept. `torch.optim.Muon`
takes matrices only; here the kernel of a convolution is one, output channels by everything else.
"""

import math
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor, nn

_COEFFICIENTS = (3.4445, -4.7750, 2.0315)
"""Of the odd polynomial that pulls singular values towards 1 fastest (Jordan et al.); it ends between 0.7 and 1.2."""

_ITERATIONS = 5
_SMALLEST = 32
"""Rows and columns from which on a weight counts as a matrix: first and last layers are left to AdamW."""


def orthogonalise(matrix: Tensor) -> Tensor:  # (R, C) float32
    """Return the nearest matrix with singular values of about 1, by Newton-Schulz iteration in float32.

    The iterates of a matrix X are q X with q a polynomial in X X^T. So the iteration runs on these small square
    matrices, and X is multiplied once: 2.5 times fewer operations than iterating X, for the same result
    (`tests/sdps/training/test_sdps_muon.py`). That is faster in float32 than the usual form in bfloat16, and nearer
    to exact.
    """
    a, b, c = _COEFFICIENTS
    tall = matrix.shape[0] > matrix.shape[1]
    x = matrix.T if tall else matrix  # (r, c), r <= c
    x = x / (x.norm() + 1e-7)
    gram = x @ x.T  # (r, r)
    product = None
    for _ in range(_ITERATIONS):
        polynomial = torch.add(b * gram, gram @ gram, alpha=c)
        polynomial.diagonal().add_(a)
        gram = polynomial @ gram @ polynomial
        product = polynomial if product is None else polynomial @ product
    x = product @ x
    return x.T if tall else x


def is_matrix(parameter: Tensor) -> bool:
    """Return whether Muon takes a parameter: kernels with at least 32 rows and columns."""
    return parameter.ndim >= 2 and min(len(parameter), parameter[0].numel()) >= _SMALLEST


class _Muon(torch.optim.Optimizer):
    """The part for matrices: Nesterov momentum, made orthogonal, as large as a typical update of AdamW."""

    def __init__(self, parameters: Iterable[Tensor], lr: float, momentum: float, weight_decay: float) -> None:
        super().__init__(parameters, {"lr": lr, "momentum": momentum, "weight_decay": weight_decay})

    @torch.no_grad()
    def step(self, closure: Any = None) -> Any:
        for group in self.param_groups:
            for parameter in group["params"]:
                if parameter.grad is None:
                    continue
                state = self.state[parameter]
                if not state:
                    state["momentum"] = torch.zeros_like(parameter)
                average = state["momentum"].mul_(group["momentum"]).add_(parameter.grad)
                update = parameter.grad.add(average, alpha=group["momentum"])
                rows = update.reshape(len(update), -1)
                scale = 0.2 * math.sqrt(max(rows.shape))
                parameter.mul_(1.0 - group["lr"] * group["weight_decay"])
                parameter.add_(orthogonalise(rows).reshape(parameter.shape), alpha=-group["lr"] * scale)


class Muon:
    """Muon for the matrices of a network and AdamW for its other parameters, as one optimiser.

    Args:
        network: Whose parameters are trained.
        lr: Learning rate of both.
        weight_decay: Of both.
        momentum: Of Muon.
    """

    def __init__(self, network: nn.Module, lr: float, weight_decay: float = 0.0, momentum: float = 0.95) -> None:
        trained = [parameter for parameter in network.parameters() if parameter.requires_grad]
        matrices = [parameter for parameter in trained if is_matrix(parameter)]
        others = [parameter for parameter in trained if not is_matrix(parameter)]
        adamw = torch.optim.AdamW(others, lr=lr, weight_decay=weight_decay, fused=True)
        self.parts = [_Muon(matrices, lr, momentum, weight_decay), adamw]

    @property
    def param_groups(self) -> list[dict[str, Any]]:
        """The groups of both parts."""
        return [group for part in self.parts for group in part.param_groups]

    def step(self) -> None:
        """Take a step."""
        for part in self.parts:
            part.step()

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Forget the gradients."""
        for part in self.parts:
            part.zero_grad(set_to_none=set_to_none)

    def state_dict(self) -> dict[str, Any]:
        """Return the state of both parts."""
        return {"muon": self.parts[0].state_dict(), "adamw": self.parts[1].state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take up a state of `state_dict`."""
        for part, name in zip(self.parts, ("muon", "adamw"), strict=True):
            part.load_state_dict(state[name])
