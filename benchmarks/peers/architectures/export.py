"""Export an architecture with random weights as ONNX, as docs/how-to/modern-networks.md does: prints JSON.

python -m peers.architectures.export NAME FILE.onnx
"""

import json
import sys
from pathlib import Path

import torch
from torch.utils.flop_counter import FlopCounterMode

from peers.architectures import ARCHITECTURES, Architecture

_SEED = 1


def export(name: str, file: Path) -> dict[str, float]:
    """Write the file, and return what `size_of` does."""
    it = ARCHITECTURES[name]
    torch.manual_seed(_SEED)
    net = it.build().eval()
    torch.onnx.export(
        net,
        torch.zeros(1, 3, it.height, it.width),
        str(file),
        input_names=["image"],
        output_names=["descriptor"],
        dynamo=False,
    )
    return size_of(it)


def size_of(it: Architecture) -> dict[str, float]:
    """Count the parameters, in millions, and the multiplications with an addition for a picture, in 10^9; no weights
    are made for that."""
    with torch.device("meta"):
        net, picture = it.build().eval(), torch.zeros(1, 3, it.height, it.width)
        with torch.no_grad(), FlopCounterMode(display=False) as counter:
            net(picture)
    return {
        "parameters_m": sum(each.numel() for each in net.parameters()) / 1e6,
        "gmacs": counter.get_total_flops() / 2e9,  # it counts both the multiplication and the addition
    }


if __name__ == "__main__":
    print(json.dumps(export(sys.argv[1], Path(sys.argv[2]))))
