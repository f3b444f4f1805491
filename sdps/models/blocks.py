"""Layers that networks are made of. Those of SDPS-Net (supplement) have no normalisation."""

import torch
from torch import Tensor, nn
from torch.nn import functional

SLOPE = 0.1
_TOGETHER = 512
"""Pixels that attend to all others at once in use, so that memory grows with the map and not with its square."""
LOG_USUAL = -2.0
"""Logarithm of the error, a distance of unit vectors, that an untrained network expects: 8 degrees."""


class Convolution(nn.Conv2d):
    """A convolution that ignores autocast, and keeps the precision of its weights, on a map of a single pixel.

    Torch 2.13 on CPUs leaves part of the gradient of a 3x3 convolution's weights uninitialised there in bfloat16.
    """

    def forward(self, features: Tensor) -> Tensor:
        if features.shape[-2:] != (1, 1) or self.kernel_size == (1, 1):
            return super().forward(features)
        with torch.autocast(features.device.type, enabled=False):
            return super().forward(features.to(self.weight.dtype))


def conv(inputs: int, outputs: int, *, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    """Convolution with bias that keeps the size at stride 1 (halves it at 2), then leaky ReLU."""
    return nn.Sequential(Convolution(inputs, outputs, kernel, stride, kernel // 2), nn.LeakyReLU(SLOPE, inplace=True))


def deconv(inputs: int, outputs: int) -> nn.Sequential:
    """Transposed convolution without bias that doubles the size, then leaky ReLU."""
    return nn.Sequential(
        nn.ConvTranspose2d(inputs, outputs, 4, stride=2, padding=1, bias=False), nn.LeakyReLU(SLOPE, inplace=True)
    )


def chord_degrees(distances: Tensor) -> Tensor:
    """Return the angles in degrees between unit vectors that lie so far apart; from 2 on, 180."""
    return torch.rad2deg(2.0 * (0.5 * distances).clamp(max=1.0).asin())


def max_over_images(features: Tensor, *, keepdim: bool = False) -> Tensor:
    """Return the maximum over the images of features (B, Q, ...), as (B, ...) or (B, 1, ...).

    By `max`, as in the authors' code, whose gradient goes to one image; that of `amax` is shared by ties, and becomes
    NaN under `torch.compile` with bfloat16 (torch 2.13).
    """
    return features.max(dim=1, keepdim=keepdim).values


def initialise(network: nn.Module) -> None:
    """Draw every weight with `kaiming_normal_` (its defaults, as the authors' code does) and zero the biases."""
    for module in network.modules():
        if isinstance(module, nn.Conv2d | nn.ConvTranspose2d):
            if module.weight.is_meta:  # shapes only; drawing nothing would load torch's compiler, for seconds
                continue
            nn.init.kaiming_normal_(module.weight)
            if module.bias is not None:
                nn.init.zeros_(module.bias)


def parameter_count(network: nn.Module) -> int:
    """Return the number of trainable scalars."""
    return sum(parameter.numel() for parameter in network.parameters())


class Exchange(nn.Module):
    """A layer for each light of a pixel that also sees the mean and the maximum over its lights."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.own = nn.Linear(width, 2 * width)
        self.shared = nn.Linear(2 * width, 2 * width, bias=False)
        self.out = nn.Linear(2 * width, width)

    def forward(self, tokens: Tensor) -> Tensor:
        """Return tokens (N, Q, C) that have seen each other; their order does not matter."""
        seen = self.norm(tokens)
        shared = self.shared(pool(seen))[:, None]
        return tokens + self.out(functional.leaky_relu(self.own(seen) + shared, SLOPE))


class LightAttention(nn.Module):
    """The lights of a pixel attend to each other: what one shows is read beside the others."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.ask, self.answer = nn.Linear(width, 3 * width), nn.Linear(width, width)
        nn.init.zeros_(self.answer.weight)
        nn.init.zeros_(self.answer.bias)

    def forward(self, tokens: Tensor) -> Tensor:
        """Return tokens (N, Q, C) that have seen each other; their order does not matter."""
        query, key, value = self.ask(self.norm(tokens)).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        if torch.is_grad_enabled() and query.device.type == "cpu":  # torch's own is slow backwards in bfloat16 there
            shares = (query @ key.transpose(-1, -2) * key.shape[-1] ** -0.5).softmax(dim=-1)
            heard = shares.to(value.dtype) @ value
        else:
            heard = functional.scaled_dot_product_attention(query, key, value)
        return tokens + self.answer(heard.transpose(1, 2).flatten(2))


def pool(tokens: Tensor) -> Tensor:
    """Return mean and maximum (N, 2 C) over the lights of tokens (N, Q, C)."""
    return torch.cat([tokens.mean(dim=1), tokens.max(dim=1).values], dim=-1)


class Surroundings(nn.Module):
    """A map's pixels at half its resolution convolve, and attend to each other, the more the nearer they lie.

    What a head makes of distances is a slope that it learns (Press et al., Train Short, Test Long, ICLR 2022), so that
    maps may be larger than those of training.

    Args:
        inputs: Channels of the map.
        width: Channels at half its resolution.
        heads: Of the attention.
        layers: How often pixels convolve and attend.
    """

    def __init__(self, inputs: int, width: int, heads: int, layers: int) -> None:
        super().__init__()
        self.heads = heads
        self.enter = conv(inputs, width, stride=2)
        self.leave = nn.ConvTranspose2d(width, inputs, 4, stride=2, padding=1)
        self.near = nn.ModuleList(nn.Sequential(conv(width, width), conv(width, width)) for _ in range(layers))
        self.norm = nn.ModuleList(nn.LayerNorm(width) for _ in range(layers))
        self.ask = nn.ModuleList(nn.Linear(width, 3 * width) for _ in range(layers))
        self.answer = nn.ModuleList(nn.Linear(width, width) for _ in range(layers))
        steep = 2.0 ** -torch.arange(1.0, heads + 1.0)  # from half a pixel's weight per pixel to hardly any
        self.slopes = nn.Parameter(steep.log().expand(layers, heads).clone())
        for parameter in self.leave.parameters():
            nn.init.zeros_(parameter)

    def forward(self, features: Tensor) -> Tensor:
        """Return features (B, C, H, W) with what their surroundings add; H and W are even."""
        seen = self.enter(features)
        for number, near in enumerate(self.near):
            seen = seen + near(seen)
            seen = seen + self.attend(seen, number)
        return features + self.leave(seen)

    def attend(self, seen: Tensor, number: int) -> Tensor:
        """Return what pixels (B, C, h, w) hear from each other in a layer; without gradients a few at a time."""
        tokens = self.norm[number](seen.flatten(2).transpose(1, 2))  # (B, h w, C)
        query, key, value = self.ask[number](tokens).unflatten(-1, (3, self.heads, -1)).permute(2, 0, 3, 1, 4)
        places = pixel_places(seen.shape[-2], seen.shape[-1], seen.device)
        slopes = self.slopes[number].exp()[:, None, None]
        if torch.is_grad_enabled():
            likeness = query @ key.transpose(-1, -2) * key.shape[-1] ** -0.5
            shares = (likeness - slopes * torch.cdist(places, places)).softmax(dim=-1)
            heard = shares.to(value.dtype) @ value
        else:
            parts = []
            for some, there in zip(query.split(_TOGETHER, dim=2), places.split(_TOGETHER), strict=True):
                bias = (-slopes * torch.cdist(there, places)).to(query.dtype)
                parts.append(functional.scaled_dot_product_attention(some, key, value, attn_mask=bias))
            heard = torch.cat(parts, dim=2)
        found = self.answer[number](heard.transpose(1, 2).flatten(2))
        return found.transpose(1, 2).unflatten(2, seen.shape[-2:])


def pixel_places(height: int, width: int, device: torch.device) -> Tensor:  # (H W, 2) float32
    """Return rows and columns of the pixels of a map, in reading order."""
    rows, columns = (torch.arange(count, device=device, dtype=torch.float32) for count in (height, width))
    return torch.stack(torch.meshgrid(rows, columns, indexing="ij"), dim=-1).flatten(0, 1)
