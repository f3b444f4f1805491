"""CNN-PS: a densely connected network from one pixel's observation map to its normal (Ikehata, ECCV 2018).

Legend: N pixels.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

MAP_SIDE = 32
"""w, the side of an observation map in cells."""

_GROWTH = 16


class CNNPS(nn.Module):
    """Regresses the normal of every pixel from its observation map (`sdps.models.observation_maps`).

    Layers and widths are those of the authors' code: two dense blocks of two convolutions, a transition that halves
    the map between them, two fully connected layers; no batch normalisation. 2,654,051 parameters, of which 2,621,568
    are the first fully connected layer. Weights start as in the authors' framework (Glorot uniform, zero biases).

    Args:
        dropout: Probability of dropping a value behind each convolution of a block, and behind the transition.
    """

    def __init__(self, *, dropout: float = 0.2) -> None:
        super().__init__()
        self.stem = nn.Conv2d(1, _GROWTH, 3, padding=1)  # 32 x 32
        self.first = _DenseBlock(16, dropout)
        self.transition = nn.Sequential(nn.ReLU(), nn.Conv2d(48, 48, 1), nn.Dropout(dropout), nn.AvgPool2d(2))
        self.second = _DenseBlock(48, dropout)  # 16 x 16
        self.last = nn.Sequential(nn.ReLU(), nn.Conv2d(80, 80, 1))
        self.hidden = nn.Linear(80 * (MAP_SIDE // 2) ** 2, 128)
        self.normal = nn.Linear(128, 3)
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.Linear):
                nn.init.xavier_uniform_(module.weight)
                assert module.bias is not None
                nn.init.zeros_(module.bias)

    def forward(self, maps: Tensor) -> Tensor:
        """Return unit normals (N, 3), float32, of observation maps (N, 1, 32, 32); N may be 0."""
        assert maps.shape[1:] == (1, MAP_SIDE, MAP_SIDE), maps.shape
        feature = self.transition(self.first(self.stem(maps)))  # (N, 48, 16, 16)
        feature = self.last(self.second(feature))  # (N, 80, 16, 16)
        hidden = functional.relu(self.hidden(feature.flatten(1))).float()  # (N, 128)
        # Never under autocast: a normal rounded to bfloat16's 8 bits moves in steps of a fifth of a degree.
        with torch.autocast(hidden.device.type, enabled=False):
            return functional.normalize(self.normal(hidden), dim=1)


class _DenseBlock(nn.Module):
    """Two convolutions, each of which sees everything before it; adds 32 channels."""

    def __init__(self, inputs: int, dropout: float) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            nn.Sequential(nn.ReLU(), nn.Conv2d(inputs + added, _GROWTH, 3, padding=1), nn.Dropout(dropout))
            for added in (0, _GROWTH)
        )

    def forward(self, feature: Tensor) -> Tensor:
        for layer in self.layers:
            feature = torch.cat([layer(feature), feature], dim=1)
        return feature
