"""CosPlace (Berton et al., CVPR 2022) and EigenPlaces (Berton et al., ICCV 2023): a residual network whose feature map
is normalised at each position, pooled by generalised means, and projected."""

import torch
from torch import nn
from torch.nn.functional import normalize

from peers.architectures.resnet import channels_of, resnet

_LEAST = 1e-6


class Pooled(nn.Module):
    """(N, 3, H, W) to (N, `length`), each of length 1."""

    def __init__(self, layers: int, length: int) -> None:
        super().__init__()
        self.backbone = resnet(layers)
        self.power = nn.Parameter(torch.tensor([3.0]))
        self.projection = nn.Linear(channels_of(layers), length)

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:
        features = normalize(self.backbone(pictures), dim=1)
        pooled = features.clamp(min=_LEAST).pow(self.power).mean(dim=(2, 3)).pow(1 / self.power)
        return normalize(self.projection(pooled), dim=1)
