"""DINOv2 SALAD (Izquierdo and Civera, CVPR 2024): the patches of a picture are shared out among 64 clusters, or thrown
into a bin, by optimal transport; beside the clusters' sums stands the token of the whole picture."""

import math

import torch
from torch import nn
from torch.nn.functional import normalize

from peers.architectures.dinov2 import LENGTH, PATCH_PX, Encoder

_CLUSTERS, _CLUSTER_LENGTH, _PICTURE_LENGTH, _HIDDEN = 64, 128, 256, 512
_ROUNDS = 3  # of Sinkhorn's algorithm


class Salad(nn.Module):
    """(N, 3, H, W), sides multiples of 14, to (N, 8448), each of length 1."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = Encoder()
        self.of_picture = _perceptron(_PICTURE_LENGTH)
        self.of_patch = _perceptron(_CLUSTER_LENGTH)
        self.scores = _perceptron(_CLUSTERS)
        self.bin = nn.Parameter(torch.tensor(1.0))

    def forward(self, pictures: torch.Tensor) -> torch.Tensor:
        patches = (pictures.shape[2] // PATCH_PX) * (pictures.shape[3] // PATCH_PX)
        tokens = self.encoder(pictures)
        picture, tokens = tokens[:, 0], tokens[:, 1:]
        shares = _transported(self.scores(tokens), self.bin, patches)
        clusters = normalize(self.of_patch(tokens).transpose(1, 2) @ shares, dim=1)
        whole = torch.cat([normalize(self.of_picture(picture), dim=1), clusters.flatten(1)], dim=1)
        return normalize(whole, dim=1)


def _perceptron(outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(LENGTH, _HIDDEN), nn.ReLU(), nn.Linear(_HIDDEN, outputs))


def _transported(scores: torch.Tensor, of_bin: torch.Tensor, patches: int) -> torch.Tensor:
    """Share out each patch of (N, patches, clusters): all clusters get equal mass, the bin what is left over."""
    full = torch.cat([scores, of_bin.expand(len(scores), patches, 1)], dim=2)
    each = -math.log(patches + _CLUSTERS)
    left_over = torch.full((1, 1, 1), each + math.log(patches - _CLUSTERS), device=scores.device)
    wanted = torch.cat([torch.full((1, 1, _CLUSTERS), each, device=scores.device), left_over], dim=2)
    of_patches = torch.zeros_like(full[:, :, :1])
    for _ in range(_ROUNDS):
        of_clusters = wanted - (full + of_patches).logsumexp(dim=1, keepdim=True)
        of_patches = each - (full + of_clusters).logsumexp(dim=2, keepdim=True)
    return (full + of_clusters + of_patches - each).exp()[:, :, :_CLUSTERS]
