"""`edgevpr train matchability`: a network that says how likely a picture's parts are found again.

It sees one of 5x5 crops at a time, as the network of the thesis does (3.2.1), and a frame's score is the mean over its
crops; so the labels of frames teach what a crop is worth. Two kinds compete: a logistic regression on eight statistics
of a crop, and a convolutional network of 6,000 weights. The better one is kept, judged on sites that it has not seen.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from edgevpr.core.arrays import Bools, Bytes, Singles
from edgevpr.core.text import progress
from edgevpr.lab.evaluate.metrics import roc_auc
from edgevpr.lab.training.labels import MATCHED, Labelled
from edgevpr.lab.training.onnxfile import ModelFile, write_model
from edgevpr.runtime.recognise.memorability import prepared_crops
from edgevpr.techniques.card import InputRule

HEIGHT, WIDTH = 48, 64  # of a crop
INPUT = InputRule(
    layout="NCHW",
    height=HEIGHT,
    width=WIDTH,
    colour="grey",
    equalise=False,
    resize="area",
    scale=1 / 255,
    mean=[0.0],
)
_BATCH = 16
_SCALES, _UNEVEN_SCALES = 4, 2
_FLOOR = 1e-4  # of what a logarithm is taken


class Statistics(nn.Module):
    """Mean, contrast, and on four scales the logarithm of the strength of edges after the contrast is taken out, with
    how unevenly they are spread on two of them; a logistic regression on all of it."""

    RATE, STEPS = 0.03, 400
    NOISE = 3 / 255  # a weaker contrast than that is the sensor's
    LENGTH = 2 + _SCALES + _UNEVEN_SCALES

    def __init__(self) -> None:
        super().__init__()
        self.norm = nn.BatchNorm1d(self.LENGTH, affine=False)
        self.linear = nn.Linear(self.LENGTH, 1)

    def forward(self, crops: torch.Tensor) -> torch.Tensor:
        mean = crops.mean((2, 3), keepdim=True)
        contrast = ((crops - mean) ** 2).mean((2, 3), keepdim=True).add(self.NOISE**2).sqrt()
        even = (crops - mean) / contrast
        said = [mean, contrast.log()]
        for scale in range(_SCALES):
            here = even[..., :-1, :-1]
            strength = (even[..., 1:, :-1] - here) ** 2 + (even[..., :-1, 1:] - here) ** 2
            usual = strength.mean((2, 3), keepdim=True) + _FLOOR
            said.append(usual.log())
            if scale < _UNEVEN_SCALES:
                said.append(((strength**2).mean((2, 3), keepdim=True) / usual**2 + _FLOOR).log())
            even = functional.avg_pool2d(even, 2)
        return torch.sigmoid(self.linear(self.norm(torch.cat(said, 1).flatten(1))))


class Convolutions(nn.Module):
    """Four convolutions and the mean of what they find."""

    RATE, STEPS = 0.003, 600

    def __init__(self) -> None:
        super().__init__()
        widths = (1, 8, 16, 24, 24)
        layers: list[nn.Module] = []
        for before, after in pairwise(widths):
            layers += [nn.Conv2d(before, after, 3, 2, 1, bias=False), nn.BatchNorm2d(after), nn.ReLU()]
        self.layers = nn.Sequential(*layers)
        self.linear = nn.Linear(widths[-1], 1)

    def forward(self, crops: torch.Tensor) -> torch.Tensor:
        return torch.sigmoid(self.linear(self.layers(crops).mean((2, 3))))


KINDS: dict[str, type[Statistics | Convolutions]] = {"statistics": Statistics, "convolutions": Convolutions}


@dataclass(frozen=True, slots=True)
class TrainingSite:
    """The pictures of one site: `crops` uint8 (N, 25, 1, 48, 64), the share of the techniques that knew each rightly,
    float32 (N,), and which are real queries, not generated, bool (N,)."""

    name: str
    crops: Bytes
    found: Singles
    is_real: Bools

    def inputs(self, frame: int) -> torch.Tensor:
        """Return a picture's crops as the network takes them, float32 (25, 1, 48, 64) in 0..1."""
        return torch.from_numpy(self.crops[frame]) / 255


def site_of(name: str, labelled: Sequence[Labelled]) -> TrainingSite:
    """Read the labelled pictures of a site, and cut them into crops as in flight."""
    pictures = (label.question.picture() for label in labelled)
    crops = np.stack([(255 * prepared_crops(picture, INPUT)).round().astype(np.uint8) for picture in pictures])
    found = np.array([label.found for label in labelled], np.float32)
    return TrainingSite(name, crops, found, np.array([label.question.change is None for label in labelled]))


def fit(kind: str, sites: Sequence[TrainingSite], seed: int) -> nn.Module:
    """Fit a network of this kind to the frames of all sites, each site as often as any other."""
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    network = KINDS[kind]().train()
    optimiser = torch.optim.AdamW(network.parameters(), KINDS[kind].RATE, weight_decay=0.01)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, KINDS[kind].STEPS)
    for _ in range(KINDS[kind].STEPS):
        chosen = [sites[number] for number in rng.integers(len(sites), size=_BATCH)]
        frames = [rng.integers(len(site.found)) for site in chosen]
        crops = torch.stack([site.inputs(frame) for site, frame in zip(chosen, frames, strict=True)])
        found = torch.tensor([float(site.found[frame]) for site, frame in zip(chosen, frames, strict=True)])
        said = network(crops.flatten(0, 1)).reshape(_BATCH, -1).mean(1)
        loss = functional.binary_cross_entropy(said, found)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return network.eval()


def scores(network: nn.Module, site: TrainingSite) -> Singles:
    """Return the score of every frame of a site, float32 (N,) in 0..1."""
    with torch.no_grad():
        said = [network(site.inputs(frame)).mean().item() for frame in range(len(site.found))]
    return np.array(said, np.float32)


@dataclass(frozen=True, slots=True)
class Unseen:
    """Result of a kind on sites that it has not seen. By site, the share of pairs of pictures, one known by most
    techniques and one not, that it puts in the right order: of `generated` changes, and of `real` queries. .5 is
    chance; None: all pictures are alike, or there are none."""

    generated: dict[str, float | None]
    real: dict[str, float | None]

    @property
    def mean(self) -> float:
        """The mean over the sites, of generated changes."""
        known = [value for value in self.generated.values() if value is not None]
        return float(np.mean(known)) if known else 0.5


def leave_one_out(kind: str, sites: Sequence[TrainingSite], seed: int) -> Unseen:
    """Fit a kind as often as there are sites, each time without one of them, and judge it on that one."""
    unseen = Unseen({}, {})
    for site in sites:
        network = fit(kind, [other for other in sites if other is not site], seed)
        said, matched = scores(network, site), site.found >= MATCHED
        for judged, of in ((unseen.generated, ~site.is_real), (unseen.real, site.is_real)):
            judged[site.name] = roc_auc(said[of], matched[of])
    return unseen


def compared(sites: Sequence[TrainingSite], seed: int) -> tuple[str, dict[str, Unseen]]:
    """Judge every kind on sites that it has not seen; return the better one, and what each does."""
    unseen = {kind: leave_one_out(kind, sites, seed) for kind in progress(KINDS, len(KINDS), "fitting")}
    return max(unseen, key=lambda kind: unseen[kind].mean), unseen


def write_network(
    network: nn.Module, out: Path, title: str, source: str, site: TrainingSite
) -> tuple[ModelFile, float]:
    """Write a fitted network, `crops` (N, 1, 48, 64) in 0..1 -> `memorability` (N, 1), and its card; tried on a picture
    of `site`. Returns the file, and the largest difference to PyTorch; raises what `write_model` raises."""
    file = ModelFile(path=out, title=title, input="crops", rule=INPUT, outputs={"memorability": "memorability"})
    return file, write_model(file, network, [site.inputs(0).numpy()], source, "run the command again")
