"""The CALC autoencoder in PyTorch (Merrill and Huang 2018, section III, and their public network definition).

The encoder is the paper's, layer by layer. Two things differ, because the paper's network saw 2.5 million pictures 42
times. First, batch normalisation follows each convolution: without it one or more of the four channels of the code
become zero for good. It is folded into the weights after training, so the network that flies has the paper's layers and
no others. Second, the decoder is three small convolutions, where the paper's is fully connected
(1064, 1064, 2048, 3648). A change of view moves things near where they were, and 130 000 numbers learn that from fewer
pictures than 11 million. The second layer of the encoder also has a threshold, so that fewer of its activations are
above zero: regions are made of activations that touch, and where most are above zero, everything is one region.
"""

import copy

import torch
from torch import nn
from torch.nn import functional

FEATURES = (128, 16, 21)
CODE = (4, 14, 19)
LRN_SIZE, LRN_ALPHA, LRN_BETA = 5, 1e-4, 0.75
_HIDDEN = 64
_THRESHOLD = 1.25  # standard deviations that an activation of the second layer must be above its channel's mean


class Encoder(nn.Module):
    """The encoder: image float32 (N, 1, 120, 160) in 0..1 to descriptor (N, 1064) of length 1 and features
    (N, 128, 16, 21).

    Pooling rounds up, as Caffe does: this gives the 1064 values.
    """

    def __init__(self, normalised: bool = False) -> None:
        """Make the layers; `normalised` adds batch normalisation, for training."""
        super().__init__()
        self.conv1 = nn.Conv2d(1, 64, 5, stride=2, padding=4)
        self.conv2 = nn.Conv2d(64, 128, 4, padding=2)
        self.conv3 = nn.Conv2d(128, CODE[0], 3)
        self.norm1 = nn.BatchNorm2d(64) if normalised else nn.Identity()
        # Without a learned scale and shift no channel can become zero everywhere, nor active everywhere.
        self.norm2 = nn.BatchNorm2d(FEATURES[0], affine=False) if normalised else nn.Identity()
        self.threshold = _THRESHOLD if normalised else 0.0
        self.norm3 = nn.BatchNorm2d(CODE[0], affine=False) if normalised else nn.Identity()

    def features(self, image: torch.Tensor) -> torch.Tensor:
        x = functional.max_pool2d(functional.relu(self.norm1(self.conv1(image))), 3, 2, ceil_mode=True)
        x = functional.relu(self.norm2(self.conv2(_response_normalised(x))) - self.threshold)
        return _response_normalised(functional.max_pool2d(x, 3, 2, ceil_mode=True))

    def code(self, features: torch.Tensor) -> torch.Tensor:
        """Compute the input of the decoder, (N, 4, 14, 19): the descriptor before it is flat and of length 1."""
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
        plain.requires_grad_(False).conv2.bias -= self.threshold
        return plain.eval()


class Autoencoder(nn.Module):
    """The autoencoder: changed image to the HOG of the unchanged one, (N, 14 * 19 * M) in 0..1, M values per block.

    The last bias starts at the mean target, so that the first steps need not learn what all pictures share.
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
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d):
                nn.init.kaiming_normal_(layer.weight, nonlinearity="relu")
                nn.init.zeros_(layer.bias)
        nn.init.normal_(self.decoder[4].weight, std=0.01)

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        seen = self.decoder(self.encoder.code(self.encoder.features(image))) + self.offset
        return torch.sigmoid(seen).permute(0, 2, 3, 1).flatten(1)


def _response_normalised(x: torch.Tensor) -> torch.Tensor:
    """Apply local response normalisation over channels (Krizhevsky et al. 2012), as ONNX and Caffe define it.

    The sums over neighbouring channels are one product with a band matrix: PyTorch's own pooling over channels is slow
    on a CPU.
    """
    channels = torch.arange(x.shape[1], device=x.device)
    band = ((channels[:, None] - channels).abs() <= LRN_SIZE // 2).to(x.dtype)
    sums = functional.conv2d(x * x, band[:, :, None, None])
    return x * (1 + LRN_ALPHA / LRN_SIZE * sums) ** -LRN_BETA
