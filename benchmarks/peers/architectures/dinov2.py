"""The encoder of DINOv2 (Oquab et al., TMLR 2024), ViT-B/14: patches of 14 pixels, 12 blocks, 12 heads, 768 numbers a
token. Its positions were learnt for 37x37 patches, and are stretched to those of the picture."""

import torch
from torch import nn
from torch.nn.functional import interpolate, scaled_dot_product_attention

PATCH_PX, LENGTH = 14, 768
_BLOCKS, _HEADS, _LEARNT_SIDE = 12, 12, 37
_NEVER_ZERO = 1e-6


class Encoder(nn.Module):
    """(N, 3, H, W), sides multiples of 14, to the tokens (N, 1 + H / 14 * W / 14, 768): first that of the picture."""

    def __init__(self) -> None:
        super().__init__()
        self.patches = nn.Conv2d(3, LENGTH, PATCH_PX, PATCH_PX)
        self.picture = nn.Parameter(torch.randn(1, 1, LENGTH))
        self.picture_position = nn.Parameter(torch.randn(1, 1, LENGTH))
        self.positions = nn.Parameter(torch.randn(1, LENGTH, _LEARNT_SIDE, _LEARNT_SIDE))
        self.blocks = nn.Sequential(*(Block() for _ in range(_BLOCKS)))
        self.norm = nn.LayerNorm(LENGTH, eps=_NEVER_ZERO)

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:
        patches = self.patches(pictures)
        positions = interpolate(self.positions, size=patches.shape[2:], mode="bicubic")
        tokens = (patches + positions).flatten(2).transpose(1, 2)
        picture = (self.picture + self.picture_position).expand(len(tokens), -1, -1)
        return self.norm(self.blocks(torch.cat([picture, tokens], dim=1)))


class Block(nn.Module):
    """Attention and a perceptron, each added to what came in by a learnt scale of each channel."""

    def __init__(self) -> None:
        super().__init__()
        self.before_attention, self.before_perceptron = (nn.LayerNorm(LENGTH, eps=_NEVER_ZERO) for _ in range(2))
        self.asked, self.joined = nn.Linear(LENGTH, 3 * LENGTH), nn.Linear(LENGTH, LENGTH)
        self.perceptron = nn.Sequential(nn.Linear(LENGTH, 4 * LENGTH), nn.GELU(), nn.Linear(4 * LENGTH, LENGTH))
        self.scale_attention, self.scale_perceptron = (nn.Parameter(torch.ones(LENGTH)) for _ in range(2))

    def forward(self, tokens: torch.Tensor) -> torch.Tensor:
        tokens = tokens + self.scale_attention * self._attention(self.before_attention(tokens))
        return tokens + self.scale_perceptron * self.perceptron(self.before_perceptron(tokens))

    def _attention(self, tokens: torch.Tensor) -> torch.Tensor:
        pictures, count, _ = tokens.shape
        by_head = self.asked(tokens).reshape(pictures, count, 3, _HEADS, LENGTH // _HEADS)
        query, key, value = by_head.permute(2, 0, 3, 1, 4)
        seen = scaled_dot_product_attention(query, key, value)
        return self.joined(seen.transpose(1, 2).reshape(pictures, count, LENGTH))
