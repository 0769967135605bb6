"""MixVPR (Ali-bey et al., WACV 2023): ResNet-50 up to its third stage, 1024 maps of 20x20, mixed by four blocks that
see a whole map at once, then projected over channels and over positions."""

import torch
from torch import nn
from torch.nn.functional import normalize

from peers.architectures.resnet import channels_of, resnet

_SIDE, _BLOCKS, _STAGES = 20, 4, 3


class MixVPR(nn.Module):
    """(N, 3, 320, 320) to (N, `channels` * `rows`), each of length 1: 1024 x 4 and 256 x 2 are the published ones."""

    def __init__(self, channels: int, rows: int) -> None:
        super().__init__()
        self.backbone = resnet(50, _STAGES)
        self.mixers = nn.ModuleList(_mixer(_SIDE * _SIDE) for _ in range(_BLOCKS))
        self.over_channels = nn.Linear(channels_of(50, _STAGES), channels)
        self.over_positions = nn.Linear(_SIDE * _SIDE, rows)

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:
        maps = self.backbone(pictures).flatten(2)
        for mixer in self.mixers:
            maps = maps + mixer(maps)
        projected = self.over_channels(maps.transpose(1, 2)).transpose(1, 2)
        return normalize(self.over_positions(projected).flatten(1), dim=1)


def _mixer(length: int) -> nn.Sequential:
    return nn.Sequential(nn.LayerNorm(length), nn.Linear(length, length), nn.ReLU(), nn.Linear(length, length))
