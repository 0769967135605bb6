"""The CALC autoencoder in PyTorch (Merrill and Huang 2018, section III, and their public network definition).

The encoder is theirs, layer by layer. Ours, because theirs saw 2.5 million pictures 42 times: batch normalisation after
each convolution, without which one or more of the four channels of the code fall silent for good (it is folded into the
weights when training is done: what flies has the paper's layers and no others), and a decoder of three small
convolutions where theirs is fully connected (1064, 1064, 2048, 3648): a change of view moves things near where they
were, and 130 000 numbers learn that from fewer pictures than 11 million. The second layer speaks only where it has
something to say: regions are made of activations that touch, and where most are above zero all is one region.
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
    """Image float32 (N, 1, 120, 160) in 0..1 -> descriptor (N, 1064) of length 1 and features (N, 128, 16, 21).

    Pooling rounds up, as Caffe does: that is where 1064 values come from.
    """

    def __init__(self, normalised: bool = False) -> None:
        """`normalised`: with batch normalisation, for training."""
        super().__init__()
        self.conv1 = nn.Conv2d(1, 64, 5, stride=2, padding=4)
        self.conv2 = nn.Conv2d(64, 128, 4, padding=2)
        self.conv3 = nn.Conv2d(128, CODE[0], 3)
        self.norm1 = nn.BatchNorm2d(64) if normalised else nn.Identity()
        # Without a scale and shift of its own no channel can fall silent, nor speak everywhere.
        self.norm2 = nn.BatchNorm2d(FEATURES[0], affine=False) if normalised else nn.Identity()
        self.threshold = _THRESHOLD if normalised else 0.0
        self.norm3 = nn.BatchNorm2d(CODE[0], affine=False) if normalised else nn.Identity()

    def features(self, image: torch.Tensor) -> torch.Tensor:
        x = functional.max_pool2d(functional.relu(self.norm1(self.conv1(image))), 3, 2, ceil_mode=True)
        x = functional.relu(self.norm2(self.conv2(_response_normalised(x))) - self.threshold)
        return _response_normalised(functional.max_pool2d(x, 3, 2, ceil_mode=True))

    def code(self, features: torch.Tensor) -> torch.Tensor:
        """What the decoder sees, (N, 4, 14, 19): the descriptor, not yet flat and of length 1."""
        return functional.relu(self.norm3(self.conv3(features)))

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        features = self.features(image)
        return functional.normalize(self.code(features).flatten(1)), features

    def folded(self) -> "Encoder":
        """The same on the CPU, with what batch normalisation has learnt in the weights of the convolutions."""
        learnt = copy.deepcopy(self).cpu().eval()
        plain = Encoder()
        for number in (1, 2, 3):
            conv, norm = getattr(learnt, f"conv{number}"), getattr(learnt, f"norm{number}")
            setattr(plain, f"conv{number}", nn.utils.fuse_conv_bn_eval(conv, norm))
        plain.requires_grad_(False).conv2.bias -= self.threshold
        return plain.eval()


class Autoencoder(nn.Module):
    """Image -> the HOG of what was seen before it was changed, (N, 14 * 19 * M) in 0..1, M values a block.

    The last bias starts where the mean target comes out: the first steps need not learn what all pictures share.
    """

    def __init__(self, mean_target: torch.Tensor) -> None:
        """`mean_target` float32 (14 * 19 * M,)."""
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
    """Local response normalisation over channels (Krizhevsky et al. 2012), as ONNX and Caffe define it.

    The sums over neighbouring channels are one product with a band matrix: PyTorch's own pooling over channels is
    slow on a CPU.
    """
    channels = torch.arange(x.shape[1], device=x.device)
    band = ((channels[:, None] - channels).abs() <= LRN_SIZE // 2).to(x.dtype)
    sums = functional.conv2d(x * x, band[:, :, None, None])
    return x * (1 + LRN_ALPHA / LRN_SIZE * sums) ** -LRN_BETA
