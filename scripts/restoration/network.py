"""The network that DeepGyro and LSD2 share: a small residual U-Net that works at half the picture's size.

Like the thesis's networks, it sees two pictures of the same scene and the blur; unlike them, one of the two is already
restored as well as the known path allows (Wiener's filter along it) or free of blur (the short exposure), and the
network says for each pixel how much of which to take, and what to add.
"""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

#: Channels at 1/2, 1/4, 1/8 and 1/16 of the picture's size, and residual blocks on the way down and up.
WIDTHS = (32, 64, 128, 176)
DOWN, UP = (1, 2, 2, 2), (2, 2, 2)
#: Sides of pictures are multiples of this.
MULTIPLE = 16


class Block(nn.Module):
    """Two convolutions whose result is added to what came in."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = nn.Conv2d(width, width, 3, padding=1)
        # as if there were no block at first
        nn.init.zeros_(self.second.weight)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.second(functional.leaky_relu(self.first(x), 0.1))


class RestorationNet(nn.Module):
    """``restored = picture + share (aid - picture) + rest``, with the share and the rest from a U-Net.

    Inputs are ``picture`` and ``aid``, (N, 3, H, W) sRGB 0 to 1, and ``blur``, (N, C, H / 2, W / 2), as
    ``colmap_inertial/imaging/restoration/_tiles.py`` makes it of paths (C = 5) or of lines (3).
    """

    def __init__(self, blur_channels: int = 5, share: float = 0.5) -> None:
        super().__init__()
        half, *_ = WIDTHS
        self.blur_channels = blur_channels
        self.enter = nn.Conv2d(2 * 12 + blur_channels, half, 3, padding=1)
        self.down = nn.ModuleList(
            nn.Sequential(*(Block(w) for _ in range(n))) for w, n in zip(WIDTHS, DOWN, strict=True)
        )
        self.shrink = nn.ModuleList(nn.Conv2d(a, b, 2, stride=2) for a, b in pairwise(WIDTHS))
        self.grow = nn.ModuleList(nn.Conv2d(b, 4 * a, 1) for a, b in pairwise(WIDTHS))
        self.up = nn.ModuleList(nn.Sequential(*(Block(w) for _ in range(n))) for w, n in zip(WIDTHS, UP, strict=False))
        self.leave = nn.Conv2d(half, 16, 3, padding=1)
        nn.init.normal_(self.leave.weight, std=1e-3)
        nn.init.zeros_(self.leave.bias)
        with torch.no_grad():
            self.leave.bias[12:] = share

    def forward(self, picture: Tensor, aid: Tensor, blur: Tensor) -> Tensor:
        x = torch.cat([functional.pixel_unshuffle(picture, 2), functional.pixel_unshuffle(aid, 2), blur], dim=1)
        x = self.enter(x)
        levels = []
        for block, shrink in zip(self.down, self.shrink, strict=False):
            x = block(x)
            levels.append(x)
            x = shrink(x)
        x = self.down[-1](x)
        for block, grow, level in zip(reversed(self.up), reversed(self.grow), reversed(levels), strict=True):
            x = block(functional.pixel_shuffle(grow(x), 2) + level)
        out = functional.pixel_shuffle(self.leave(x), 2)
        # pixel_shuffle makes the first twelve channels the rest in colours, the last four the share
        rest, share = out[:, :3], out[:, 3:]
        return picture + share * (aid - picture) + rest


def parameters(network: nn.Module) -> int:
    """How many weights there are."""
    return sum(p.numel() for p in network.parameters())


class ThesisNet(nn.Module):
    """The yardstick: a U-Net at the picture's full size on picture and blur alone, as DeepGyro's (WACV 2019).

    Two convolutions at each of five sizes, the halves by the largest of four, doubled by learned interpolation, what
    was found on the way down beside what comes up. Of the original's 31 million weights at 64 channels; the same inputs
    as :class:`RestorationNet`, of which it leaves the second picture and the bend of paths alone.
    """

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        widths = [width * 2**level for level in range(5)]
        self.down = nn.ModuleList(_two(a, b) for a, b in pairwise([6, *widths]))
        self.grow = nn.ModuleList(nn.ConvTranspose2d(b, a, 2, stride=2) for a, b in pairwise(widths))
        self.up = nn.ModuleList(_two(2 * a, a) for a in widths[:-1])
        self.leave = nn.Conv2d(width, 3, 1)
        self.blur_channels = 5

    def forward(self, picture: Tensor, aid: Tensor, blur: Tensor) -> Tensor:
        # the exporter leaves out what nothing depends on
        x = torch.cat([picture + 0 * aid, functional.interpolate(blur[:, :3], scale_factor=2.0)], dim=1)
        levels = []
        for i, convolve in enumerate(self.down):
            x = convolve(x if i == 0 else functional.max_pool2d(x, 2))
            levels.append(x)
        for grow, convolve, level in zip(reversed(self.grow), reversed(self.up), reversed(levels[:-1]), strict=True):
            x = convolve(torch.cat([level, grow(x)], dim=1))
        return picture + self.leave(x)


def _two(entering: int, width: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(entering, width, 3, padding=1), nn.ReLU(), nn.Conv2d(width, width, 3, padding=1), nn.ReLU()
    )
