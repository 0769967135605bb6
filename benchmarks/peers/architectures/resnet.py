"""Residual networks (He et al., CVPR 2016) up to a feature map: 18 or 50 layers, with the stride of a block of three in
its 3x3 convolution, as torchvision has it."""

import torch
from torch import nn

_BLOCKS = {18: (2, 2, 2, 2), 50: (3, 4, 6, 3)}


class Residual(nn.Module):
    """A block: convolutions of these kernels and channels, each with batch normalisation, around a shortcut."""

    def __init__(self, inputs: int, kernels: tuple[int, ...], channels: tuple[int, ...], stride: int) -> None:
        super().__init__()
        layers, before = [], inputs
        strided = kernels.index(3)  # the first 3x3 convolution makes the map smaller
        for number, (kernel, after) in enumerate(zip(kernels, channels, strict=True)):
            layers += [_convolution(before, after, kernel, stride if number == strided else 1), nn.ReLU()]
            before = after
        self.way = nn.Sequential(*layers[:-1])
        is_same = stride == 1 and inputs == before
        self.shortcut = nn.Identity() if is_same else _convolution(inputs, before, 1, stride)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.relu(self.way(x) + self.shortcut(x))


def resnet(layers: int, stages: int = 4) -> nn.Sequential:
    """Build the network of 18 or 50 layers without its classifier, up to one of its four stages: (N, 3, H, W) to
    (N, C, H / 2^(stages + 1), ...), C of `channels_of`."""
    parts = [_convolution(3, 64, 7, 2), nn.ReLU(), nn.MaxPool2d(3, 2, 1)]
    inputs = 64
    for stage, blocks in enumerate(_BLOCKS[layers][:stages]):
        width = 64 << stage
        kernels, channels = ((3, 3), (width, width)) if layers == 18 else ((1, 3, 1), (width, width, 4 * width))
        for block in range(blocks):
            parts.append(Residual(inputs, kernels, channels, 2 if stage and not block else 1))
            inputs = channels[-1]
    return nn.Sequential(*parts)


def channels_of(layers: int, stages: int = 4) -> int:
    """Return the channels of the feature map."""
    return (64 << (stages - 1)) * (1 if layers == 18 else 4)


def _convolution(inputs: int, outputs: int, kernel: int, stride: int) -> nn.Sequential:
    return nn.Sequential(nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False), nn.BatchNorm2d(outputs))
