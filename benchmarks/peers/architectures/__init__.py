"""The architectures of four modern networks of place recognition, written from their papers, without their weights.

What they cost does not depend on what they have learnt. Each is checked by what its authors, or those of its backbone,
say of its size: `tests/test_peers.py`.
"""

from collections.abc import Callable
from dataclasses import dataclass

from torch import nn

from peers.architectures.mixvpr import MixVPR
from peers.architectures.pooled import Pooled
from peers.architectures.salad import Salad


@dataclass(frozen=True, slots=True, kw_only=True)
class Architecture:
    """A network, and the size of the picture that it takes."""

    build: Callable[[], nn.Module]
    height: int
    width: int


# EigenPlaces has the network of CosPlace: the papers differ in how it is trained.
ARCHITECTURES = {
    "cosplace": Architecture(build=lambda: Pooled(18, 512), height=480, width=640),
    "cosplace_resnet50": Architecture(build=lambda: Pooled(50, 2048), height=480, width=640),
    "eigenplaces": Architecture(build=lambda: Pooled(50, 2048), height=480, width=640),
    "mixvpr": Architecture(build=lambda: MixVPR(1024, 4), height=320, width=320),
    "salad": Architecture(build=Salad, height=322, width=322),
}
