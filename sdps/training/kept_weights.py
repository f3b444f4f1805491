"""Which weights are validated and saved: the trained ones, their average over steps, or a mean with the first."""

import copy

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn


class KeptWeights:
    """The weights that a run keeps of the network it trains.

    Args:
        network: The network, with its initial weights.
        ema: Decay of the average over steps; 0 for no average.
        start_share: Share of the initial weights in the kept ones.
        added: Names of weights that the start lacks: they are kept as trained.
    """

    def __init__(self, network: nn.Module, ema: float, start_share: float, added: frozenset[str] = frozenset()) -> None:
        self._trained, self._start_share, self._added = network, start_share, added
        self._average = AveragedModel(network, multi_avg_fn=get_ema_multi_avg_fn(ema)) if ema else None
        self._start = copy.deepcopy(network) if start_share else None

    def update(self) -> None:
        """Add the weights after a step to the average."""
        if self._average is not None:
            self._average.update_parameters(self._trained)

    @torch.no_grad()
    def network(self) -> nn.Module:
        """Return the network with the kept weights."""
        kept: nn.Module = self._trained if self._average is None else self._average.module
        if self._start is None:
            return kept
        mixed, last = copy.deepcopy(self._start), kept.state_dict()
        for name, weight in mixed.state_dict().items():  # shares memory with the network
            alone = name in self._added or not weight.is_floating_point()
            weight.copy_(last[name] if alone else torch.lerp(last[name], weight, self._start_share))
        return mixed

    def are_finite(self) -> bool:
        """Return whether no weight is infinite or NaN."""
        return all(bool(torch.isfinite(weight).all()) for weight in self.network().state_dict().values())

    def state_dict(self) -> dict[str, Tensor]:
        """Return what a checkpoint holds of the average."""
        return {} if self._average is None else self._average.state_dict()

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Go on with the average of a checkpoint."""
        if self._average is not None:
            self._average.load_state_dict(state)
