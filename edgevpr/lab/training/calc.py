"""`edgevpr train calc`: the encoder learns to ignore a change of view and light (Merrill and Huang 2018).

The target is the HOG of a picture. The input is the same ground from elsewhere in other light. There are no labels. The
encoder and the L2 loss are the paper's. Different are the target (see `pictures`), the decoder (see `network`), and
Adam with a rate that falls like a cosine instead of plain momentum.
"""

import hashlib
import io
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn import functional

from edgevpr.core.errors import UsageError
from edgevpr.core.files import write_whole
from edgevpr.lab.training.network import Autoencoder, Encoder
from edgevpr.lab.training.pictures import batch, gradients_of, require_enough, two_sights

BATCH = 32
_RATE = 2e-3
_WARM_UP_STEPS = 100
_STEPS_BETWEEN_CHECKPOINTS = 250


class Training:
    """One training, step by step. `step` is the number of steps done, `losses` are those of this run.

    The pictures of a step follow from the seed and the number of the step alone. So a training that was stopped and
    goes on from its checkpoint ends as one that was not (but for the last bit: OpenCV's sums depend on where an array
    lies).
    """

    def __init__(self, pictures: Sequence[np.ndarray], steps: int, seed: int) -> None:
        """Prepare the training; `pictures` are uint8 grey. Raises UsageError for too few of them."""
        require_enough(pictures)
        self.pictures, self.steps, self.seed, self.step = pictures, steps, seed, 0
        self.losses: list[float] = []
        self._device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
        # bfloat16 doubles the speed where the processor has it, and is as good: the weights stay float32.
        self._halves = _has_halves(self._device)
        torch.manual_seed(seed)
        network = Autoencoder(torch.from_numpy(_mean_target(pictures, seed)))
        self._network = network.to(self._device, memory_format=torch.channels_last)
        self._optimiser = torch.optim.Adam(self._network.parameters(), _RATE)

    def encoder(self) -> Encoder:
        """Return the encoder after the steps done so far, ready to be written."""
        return self._network.encoder.folded()

    def run(self, checkpoint: Path) -> Iterator[int]:
        """Do the steps that are left, yielding the number of those done; save `checkpoint` every 250 steps."""
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
        loss.backward()
        self._optimiser.step()
        self.step += 1
        self.losses.append(loss.item())

    def save(self, path: Path) -> None:
        """Write everything that is needed to go on. A failure leaves the file as it was before."""
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
        """Go on from a checkpoint. Raises UsageError for a file that cannot be read or is of another training."""
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
            digest.update(picture)
        return digest.hexdigest()


def _has_halves(device: torch.device) -> bool:
    """Tell whether bfloat16 is fast on this device, and not only possible."""
    if device.type == "cuda":
        return torch.cuda.get_device_capability(device)[0] >= 8
    try:
        return "bf16" in Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        return False


def _mean_target(pictures: Sequence[np.ndarray], seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    some = [pictures[index] for index in rng.permutation(len(pictures))[:512]]
    return np.mean([gradients_of(two_sights(picture, rng)[0]) for picture in some], axis=0)


def _rate(step: int, steps: int) -> float:
    """Return the learning rate of a step: it rises over the first steps, then falls like half a cosine to zero."""
    return _RATE * min(1, (step + 1) / _WARM_UP_STEPS) * (0.5 + 0.5 * math.cos(math.pi * step / steps))
