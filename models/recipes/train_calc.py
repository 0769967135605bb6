"""Trains the CALC autoencoder (Merrill and Huang 2018) in PyTorch on one's own pictures, without any labels:
`python models/recipes/train_calc.py --images DIR... --out FILE.onnx`. Needs `pip install '.[train]'`.

The encoder learns to ignore a change of view and light: from a changed picture it learns to tell the HOG of the same
ground, seen from elsewhere in other light. models/README.md says what differs from the paper, and why.
"""

import argparse
import copy
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.nn import functional
from training_pictures import at_most, read_pictures
from write_onnx import ModelFile, write_model

from edgevpr.core.arrays import Array, Doubles, Image, Singles
from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.core.text import progress
from edgevpr.frames.images import cv2
from edgevpr.techniques.card import InputRule
from edgevpr.techniques.gradients import compute_histograms, normalise_blocks

HEIGHT, WIDTH = 120, 160  # of the network's input
CODE = (4, 14, 19)
_FEATURES = 128
_LRN_SIZE, _LRN_ALPHA, _LRN_BETA = 5, 1e-4, 0.75
_HIDDEN = 64
_THRESHOLD = 1.25  # standard deviations that an activation of the second layer must be above its channel's mean
_CELL_PX = 8
_ORIENTATIONS = 9
# 14 x 19 blocks of 2x2 cells.
TARGET_LENGTH = (HEIGHT // _CELL_PX - 1) * (WIDTH // _CELL_PX - 1) * 4 * _ORIENTATIONS
_LONGEST_PX = 320  # twice the network's input: enough for a part of a picture
_SMALLEST_PART = 0.85
_CORNER_MOVES = 0.1  # of the sides of the view
_LIGHT_VARIES = 0.5  # standard deviation of the logarithm of the light over the view
_NOISE = 2.0  # largest standard deviation, in grey levels
BATCH = 32
_RATE = 2e-3
_WARM_UP_STEPS = 100
_MIN_PICTURES = 16
_CHECKED_INPUTS = 16
_LOSSES_SAID = 50  # steps over which the reported loss is averaged: one batch says little
_CPU = Path("/proc/cpuinfo")
_INPUT = InputRule(
    layout="NCHW",
    height=HEIGHT,
    width=WIDTH,
    colour="grey",
    equalise=True,
    resize="cubic",
    scale=1 / 255,
    mean=[0.0],
)


def main(argv: Sequence[str] | None = None) -> None:
    """Train on the images that the arguments name, and write the network and its card."""
    parser = argparse.ArgumentParser(description="Train the CALC autoencoder; no labels are needed.")
    parser.add_argument("--images", required=True, nargs="+", metavar="DIR", help="folders of images")
    parser.add_argument("--out", required=True, type=Path, metavar="FILE.onnx", help="its card lies beside it")
    parser.add_argument("--steps", type=int, default=4000, metavar="N", help="batches of 32 pictures (4000)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="(1)")
    args = parser.parse_args(argv)
    if args.out.suffix != ".onnx" or args.out.exists() or not args.out.resolve().parent.is_dir():
        raise UsageError(f"--out {args.out}: give a new file that ends in .onnx, in a folder that is there.")
    pictures = [small_grey(picture) for picture in read_pictures(args.images, "reading")]
    if len(pictures) < _MIN_PICTURES:
        raise UsageError(
            f"{len(pictures)} usable images are too few to learn from: give folders with {_MIN_PICTURES} at the very "
            "least, better thousands, of the kind of ground that will be flown over."
        )
    cv2.setNumThreads(1)
    encoder, losses = fitted(pictures, args.steps, args.seed)
    inputs, _ = batch(pictures, _CHECKED_INPUTS, np.random.default_rng(args.seed))
    folders = ", ".join(Path(folder).as_posix() for folder in args.images)
    file = ModelFile(
        path=args.out,
        title="CALC (Merrill and Huang 2018), trained by edgevpr",
        source=f"train_calc.py --steps {args.steps} --seed {args.seed}; {len(pictures)} images of {folders}",
        input="image",
        rule=_INPUT,
        outputs={"descriptor": "descriptor", "features": "features"},
    )
    largest = write_model(file, encoder, list(inputs[:, None]))
    print(
        f"{args.out}: {len(pictures)} images, mean loss of the last {_LOSSES_SAID} steps "
        f"{np.mean(losses[-_LOSSES_SAID:]):.4f}, differs from PyTorch by {largest:.2g}"
    )


def fitted(pictures: Sequence[Image], steps: int, seed: int) -> "tuple[Encoder, list[float]]":
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


def small_grey(image: Image) -> Image:
    """Convert a uint8 image to the form that `batch` takes: uint8 grey, the longer side at most 320 pixels."""
    grey: Array = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return at_most(grey, _LONGEST_PX)


def batch(pictures: Sequence[Image], size: int, rng: np.random.Generator) -> tuple[Singles, Singles]:
    """Make a random batch: inputs float32 (size, 1, 120, 160) in 0..1, and targets float32 (size, TARGET_LENGTH)."""
    inputs = np.empty((size, 1, HEIGHT, WIDTH), np.float32)
    targets = np.empty((size, TARGET_LENGTH), np.float32)
    for row in range(size):
        sight, changed = two_sights(pictures[int(rng.integers(len(pictures)))], rng)
        inputs[row, 0] = cv2.equalizeHist(changed)
        targets[row] = gradients_of(sight)
    inputs /= 255
    return inputs, targets


def gradients_of(sight: Image) -> Singles:
    """Compute the target, the HOG of a view: uint8 (120, 160) to float32 (TARGET_LENGTH,) in 0..1. Cells are 8x8
    pixels, blocks 2x2 cells with a stride of one cell, orientations 9 over 180 degrees."""
    return normalise_blocks(compute_histograms(sight, _CELL_PX, _ORIENTATIONS, signed=False)).ravel()


def two_sights(picture: Image, rng: np.random.Generator) -> tuple[Image, Image]:
    """Return two views of a grey picture, uint8 (120, 160) each: a random part of it, and about the same ground, seen
    from elsewhere in other light."""
    height, width = picture.shape
    largest = min(width / WIDTH, height / HEIGHT)
    scale = largest * rng.uniform(_SMALLEST_PART, 1)
    size = np.array([WIDTH, HEIGHT]) * scale
    corner = rng.uniform(0, 1, 2) * (np.array([width, height]) - size)
    corners = corner + np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * size
    if rng.random() < 0.5:
        corners = corners[[1, 0, 3, 2]]
    moved = corners + rng.uniform(-_CORNER_MOVES, _CORNER_MOVES, (4, 2)) * size
    return _seen(picture, corners), _relit(_seen(picture, moved), rng)


def _seen(picture: Image, corners: Doubles) -> Image:
    frame = np.array([[0, 0], [WIDTH, 0], [WIDTH, HEIGHT], [0, HEIGHT]], np.float32)
    to_frame = cv2.getPerspectiveTransform(corners.astype(np.float32), frame)
    sight: Array = cv2.warpPerspective(
        picture, to_frame, (WIDTH, HEIGHT), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101
    )
    return sight


def _relit(sight: Image, rng: np.random.Generator) -> Image:
    """Change gamma, brightness (mostly darker) and light (uneven, as under clouds), and add noise of the sensor."""
    light: Array = rng.normal(0, _LIGHT_VARIES * rng.random(), (3, 4)).astype(np.float32)
    light = np.exp(cv2.resize(light, (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC))
    changed = (sight / np.float32(255)) ** np.float32(rng.uniform(0.6, 1.6))
    changed *= light * np.float32(255 * rng.uniform(0.5, 1.1))
    changed += rng.standard_normal(changed.shape, np.float32) * np.float32(rng.uniform(0, _NOISE))
    return np.clip(changed, 0, 255).astype(np.uint8)


if __name__ == "__main__":
    try:
        main()
    except EdgevprError as error:
        sys.exit(f"train_calc: {error}")
