"""`edgevpr train calc`: the CALC autoencoder (Merrill and Huang 2018) in PyTorch, trained on one's own pictures.

The encoder learns to ignore a change of view and light: from a changed picture it learns to tell the HOG of the same
ground, seen from elsewhere in other light. models/README.md says what differs from the paper, and why.
"""

import copy
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from edgevpr.core.arrays import Image, Singles
from edgevpr.core.text import progress
from edgevpr.lab.training.pictures import batch, gradients_of, two_sights

CODE = (4, 14, 19)
_FEATURES = 128
_LRN_SIZE, _LRN_ALPHA, _LRN_BETA = 5, 1e-4, 0.75
_HIDDEN = 64
_THRESHOLD = 1.25  # standard deviations that an activation of the second layer must be above its channel's mean
BATCH = 32
_RATE = 2e-3
_WARM_UP_STEPS = 100
_CPU = Path("/proc/cpuinfo")


class Encoder(nn.Module):
    """The encoder: image float32 (N, 1, 120, 160) in 0..1 to descriptor (N, 1064), of length 1, and features (N, 128,
    16, 21). Pooling rounds sizes up, as Caffe does: this gives the 1064 values."""

    def __init__(self, normalised: bool = False) -> None:
        """Make the layers; `normalised` adds batch normalisation and the threshold, for training."""
        super().__init__()
        self.conv1 = nn.Conv2d(1, 64, 5, stride=2, padding=4)
        self.conv2 = nn.Conv2d(64, 128, 4, padding=2)
        self.conv3 = nn.Conv2d(128, CODE[0], 3)
        self.norm1 = nn.BatchNorm2d(64) if normalised else nn.Identity()
        # Without a learned scale and shift no channel can become zero everywhere, nor active everywhere.
        self.norm2 = nn.BatchNorm2d(_FEATURES, affine=False) if normalised else nn.Identity()
        self.threshold = _THRESHOLD if normalised else 0.0
        self.norm3 = nn.BatchNorm2d(CODE[0], affine=False) if normalised else nn.Identity()

    def features(self, image: torch.Tensor) -> torch.Tensor:
        x = functional.max_pool2d(functional.relu(self.norm1(self.conv1(image))), 3, 2, ceil_mode=True)
        x = functional.relu(self.norm2(self.conv2(_response_normalised(x))) - self.threshold)
        return _response_normalised(functional.max_pool2d(x, 3, 2, ceil_mode=True))

    def code(self, features: torch.Tensor) -> torch.Tensor:
        """Compute the decoder's input, (N, 4, 14, 19): the descriptor before it is flattened and scaled to length 1."""
        return functional.relu(self.norm3(self.conv3(features)))

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        features = self.features(image)
        return functional.normalize(self.code(features).flatten(1)), features

    def folded(self) -> "Encoder":
        """Return the same encoder on the CPU, with batch normalisation and threshold folded into the convolutions."""
        learnt = copy.deepcopy(self).cpu().eval()
        plain = Encoder()
        for number in (1, 2, 3):
            conv, norm = getattr(learnt, f"conv{number}"), getattr(learnt, f"norm{number}")
            setattr(plain, f"conv{number}", nn.utils.fuse_conv_bn_eval(conv, norm))
        weights = plain.requires_grad_(False).eval().state_dict()
        weights["conv2.bias"] -= self.threshold  # in place: of the encoder itself
        return plain


class Autoencoder(nn.Module):
    """The autoencoder: changed image to the HOG of the unchanged one, (N, 14 * 19 * M) in 0..1, M values per block.

    The last bias, `offset`, starts at the mean target, so that the first steps need not learn what all pictures share.
    """

    def __init__(self, mean_target: torch.Tensor) -> None:
        """Make the layers; `mean_target` is float32 (14 * 19 * M,)."""
        super().__init__()
        blocks = mean_target.reshape(CODE[1], CODE[2], -1).permute(2, 0, 1)
        self.encoder = Encoder(normalised=True)
        self.decoder = nn.Sequential(
            nn.Conv2d(CODE[0], _HIDDEN, 5, padding=2),
            nn.ReLU(),
            nn.Conv2d(_HIDDEN, _HIDDEN, 5, padding=2),
            nn.ReLU(),
            nn.Conv2d(_HIDDEN, len(blocks), 3, padding=1),
        )
        self.offset = nn.Parameter(torch.logit(blocks, 1e-3))
        for name, value in self.named_parameters():
            if name.endswith("weight") and value.ndim == 4:
                nn.init.kaiming_normal_(value, nonlinearity="relu")
            elif name.endswith("bias"):
                nn.init.zeros_(value)
        nn.init.normal_(self.decoder.get_parameter("4.weight"), std=0.01)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        seen = self.decoder(self.encoder.code(self.encoder.features(image))) + self.offset
        return torch.sigmoid(seen).permute(0, 2, 3, 1).flatten(1)


def _response_normalised(x: torch.Tensor) -> torch.Tensor:
    """Apply local response normalisation over channels (Krizhevsky et al. 2012), as ONNX and Caffe define it."""
    # One product with a band matrix: PyTorch's own pooling over channels is slow on a CPU.
    channels = torch.arange(x.shape[1], device=x.device)
    band = ((channels[:, None] - channels).abs() <= _LRN_SIZE // 2).to(x.dtype)
    sums = functional.conv2d(x * x, band[:, :, None, None])
    return x * (1 + _LRN_ALPHA / _LRN_SIZE * sums) ** -_LRN_BETA


def fitted(pictures: Sequence[Image], steps: int, seed: int) -> tuple[Encoder, list[float]]:
    """Train `steps` steps on uint8 grey `pictures`, with a progress line. Returns the encoder, ready to be written, and
    the loss of each step. The same seed gives the same result (but for the last bit)."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    # bfloat16 doubles the speed of a CPU that has it, and is as good: the weights stay float32.
    halves = device.type == "cpu" and _CPU.is_file() and "bf16" in _CPU.read_text(encoding="utf-8")
    torch.manual_seed(seed)
    network = Autoencoder(torch.from_numpy(_mean_target(pictures, seed))).to(device)
    optimiser = torch.optim.Adam(network.parameters(), _RATE)
    # The rate rises over the first 100 steps, then falls like half a cosine to zero.
    rate = torch.optim.lr_scheduler.LambdaLR(
        optimiser,
        lambda step: min(1, (step + 1) / _WARM_UP_STEPS) * (0.5 + 0.5 * math.cos(math.pi * step / steps)),
    )
    losses = []
    for step in progress(range(steps), steps, "training"):
        rng = np.random.default_rng([seed, step])
        inputs, targets = (torch.from_numpy(part).to(device) for part in batch(pictures, BATCH, rng))
        with torch.autocast(device.type, torch.bfloat16, enabled=halves):
            seen = network(inputs.contiguous(memory_format=torch.channels_last))
        loss = functional.mse_loss(seen.float(), targets)
        optimiser.zero_grad()
        torch.autograd.backward(loss)
        optimiser.step()
        rate.step()
        losses.append(loss.item())
    encoder: Encoder = network.encoder
    return encoder.folded(), losses


def _mean_target(pictures: Sequence[Image], seed: int) -> Singles:
    rng = np.random.default_rng(seed)
    some = [pictures[index] for index in rng.permutation(len(pictures))[:512]]
    mean: Singles = np.mean([gradients_of(two_sights(picture, rng)[0]) for picture in some], axis=0)
    return mean
