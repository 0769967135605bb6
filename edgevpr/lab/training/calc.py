"""`edgevpr train calc`: the CALC autoencoder in PyTorch, and its training on one's own pictures, without labels.

The encoder learns to ignore a change of view and light (Merrill and Huang 2018, section III, and their public network
definition). The target is the HOG of a picture. The input is the same ground from elsewhere in other light. The encoder
and the L2 loss are the paper's. The target differs (see `pictures`), and so do the decoder and the optimiser: Adam with
a rate that falls like a cosine instead of plain momentum.

The network differs in three ways, because the paper trains on 2.5 million pictures, 42 times each. First, batch
normalisation follows each convolution: without it one or more of the four channels of the code become zero for good. It
is folded into the weights after training, so the network that flies has the paper's layers and no others. Second, the
decoder is three small convolutions, where the paper's is fully connected (1064, 1064, 2048, 3648). A change of view
moves things only a little. 130 000 weights learn that from fewer pictures than 11 million do. Third, the second layer
of the encoder has a threshold, so that fewer of its activations are above zero: regions are made of activations that
touch, and where most are above zero, everything is one region.
"""

import copy
import hashlib
import io
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from edgevpr.core.arrays import Image, Singles
from edgevpr.core.errors import UsageError
from edgevpr.core.files import write_whole
from edgevpr.lab.training.pictures import batch, gradients_of, require_enough, two_sights

CODE = (4, 14, 19)
_FEATURES = 128
_LRN_SIZE, _LRN_ALPHA, _LRN_BETA = 5, 1e-4, 0.75
_HIDDEN = 64
_THRESHOLD = 1.25  # standard deviations that an activation of the second layer must be above its channel's mean
BATCH = 32
_RATE = 2e-3
_WARM_UP_STEPS = 100
_STEPS_BETWEEN_CHECKPOINTS = 250


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
    """Apply local response normalisation over channels (Krizhevsky et al. 2012), as ONNX and Caffe define it.

    The sums over neighbouring channels are one product with a band matrix: PyTorch's own pooling over channels is slow
    on a CPU.
    """
    channels = torch.arange(x.shape[1], device=x.device)
    band = ((channels[:, None] - channels).abs() <= _LRN_SIZE // 2).to(x.dtype)
    sums = functional.conv2d(x * x, band[:, :, None, None])
    return x * (1 + _LRN_ALPHA / _LRN_SIZE * sums) ** -_LRN_BETA


class Training:
    """One training, step by step. `step` is the number of steps done, `losses` are those of the steps of this run.

    The pictures of a step follow from the seed and the number of the step alone. So a training that is stopped and
    continued from its checkpoint gives the same result as one without a stop (but for the last bit: OpenCV's sums
    depend on the address of an array).
    """

    def __init__(self, pictures: Sequence[Image], steps: int, seed: int) -> None:
        """Prepare the training of `steps` steps; `pictures` are uint8 grey. Raises UsageError for too few of them."""
        require_enough(pictures)
        self.pictures, self.steps, self.seed, self.step = pictures, steps, seed, 0
        self.losses: list[float] = []
        self._device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        # bfloat16 doubles the speed where the processor has it, and is as good: the weights stay float32.
        self._halves = _has_halves(self._device)
        torch.manual_seed(seed)
        self._network = Autoencoder(torch.from_numpy(_mean_target(pictures, seed))).to(self._device)
        self._optimiser = torch.optim.Adam(self._network.parameters(), _RATE)

    def encoder(self) -> Encoder:
        """Return the encoder after the steps done so far, ready to be written."""
        encoder: Encoder = self._network.encoder
        return encoder.folded()

    def run(self, checkpoint: Path) -> Iterator[int]:
        """Do the remaining steps, yielding the number done after each; save `checkpoint` every 250 steps."""
        while self.step < self.steps:
            self._one_step()
            if self.step % _STEPS_BETWEEN_CHECKPOINTS == 0:
                self.save(checkpoint)
            yield self.step

    def _one_step(self) -> None:
        rng = np.random.default_rng([self.seed, self.step])
        inputs, targets = (torch.from_numpy(part).to(self._device) for part in batch(self.pictures, BATCH, rng))
        for group in self._optimiser.param_groups:
            group["lr"] = _rate(self.step, self.steps)
        with torch.autocast(self._device.type, torch.bfloat16, enabled=self._halves):
            seen = self._network(inputs.contiguous(memory_format=torch.channels_last))
        loss = functional.mse_loss(seen.float(), targets)
        self._optimiser.zero_grad()
        torch.autograd.backward(loss)
        self._optimiser.step()
        self.step += 1
        self.losses.append(loss.item())

    def save(self, path: Path) -> None:
        """Write everything that is needed to continue to `path`. A failure leaves the file as it was before."""
        state = {
            "key": self._key(),
            "step": self.step,
            "network": self._network.state_dict(),
            "optimiser": self._optimiser.state_dict(),
        }
        content = io.BytesIO()
        torch.save(state, content)
        write_whole(path, lambda unfinished: unfinished.write_bytes(content.getbuffer()))

    def load(self, path: Path) -> None:
        """Continue from a checkpoint. Raises UsageError for a file that cannot be read or is of another training."""
        try:
            state: dict[str, Any] = torch.load(path, map_location=self._device, weights_only=True)
            same = state["key"] == self._key()
        except OSError as error:
            raise UsageError(
                f"{path} cannot be read ({error.strerror}): there is nothing to resume; leave --resume out."
            ) from error
        except Exception as error:  # torch raises whatever its unpickler does
            raise UsageError(f"{path} is no checkpoint of a training: delete it and leave --resume out.") from error
        if not same:
            raise UsageError(
                f"{path} is of a training with other images, --steps or --seed: give the same, or delete it to begin "
                "anew."
            )
        self._network.load_state_dict(state["network"])
        self._optimiser.load_state_dict(state["optimiser"])
        self.step = state["step"]

    def _key(self) -> str:
        digest = hashlib.sha256(f"{self.steps} {self.seed}".encode())
        for picture in self.pictures:
            digest.update(np.ascontiguousarray(picture).data)
        return digest.hexdigest()


def _has_halves(device: torch.device) -> bool:
    """Tell whether bfloat16 arithmetic is fast on this device, not merely possible."""
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device)[0] >= 8
    try:
        return "bf16" in Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return False


def _mean_target(pictures: Sequence[Image], seed: int) -> Singles:
    rng = np.random.default_rng(seed)
    some = [pictures[index] for index in rng.permutation(len(pictures))[:512]]
    mean: Singles = np.mean([gradients_of(two_sights(picture, rng)[0]) for picture in some], axis=0)
    return mean


def _rate(step: int, steps: int) -> float:
    """Return the learning rate of a step of `steps`: it rises over the first 100, then falls like half a cosine to
    zero."""
    return _RATE * min(1, (step + 1) / _WARM_UP_STEPS) * (0.5 + 0.5 * math.cos(math.pi * step / steps))
