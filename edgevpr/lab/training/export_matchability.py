"""Export of a network of matchability as ONNX, written node by node: the same for every PyTorch."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from edgevpr.lab.training.export import require_small, save
from edgevpr.lab.training.matchability import FLOOR, HEIGHT, INPUT, SCALES, UNEVEN_SCALES, WIDTH, Small, Statistics
from edgevpr.runtime.preflight.networks import card_text
from edgevpr.techniques.session import file_sha256

_LAST = 2**31


class _Graph:
    """Nodes and weights as they are added; every function returns the name of what it makes."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.weights: list[onnx.TensorProto] = []

    def add(self, kind: str, *inputs: str, **attributes: object) -> str:
        """Add a node with one output."""
        name = f"{kind.lower()}{len(self.nodes)}"
        self.nodes.append(helper.make_node(kind, list(inputs), [name], **attributes))
        return name

    def weight(self, values: object, dtype: type = np.float32) -> str:
        """Add a constant."""
        name = f"w{len(self.weights)}"
        self.weights.append(numpy_helper.from_array(np.ascontiguousarray(values, dtype), name))
        return name

    def mean(self, of: str) -> str:
        """Take the mean over rows and columns, which stay as axes of 1."""
        return self.add("ReduceMean", of, axes=[2, 3], keepdims=1)


def write_onnx(network: nn.Module, path: Path) -> None:
    """Write a fitted network: `crops` (N, 1, 48, 64) in 0..1 -> `memorability` (N, 1), both float32."""
    graph = _Graph()
    logit = _statistics(graph, network) if isinstance(network, Statistics) else _small(graph, network)
    graph.nodes.append(helper.make_node("Sigmoid", [logit], ["memorability"]))
    whole = helper.make_graph(
        graph.nodes,
        "matchability",
        [helper.make_tensor_value_info("crops", TensorProto.FLOAT, ["n", 1, HEIGHT, WIDTH])],
        [helper.make_tensor_value_info("memorability", TensorProto.FLOAT, ["n", 1])],
        graph.weights,
    )
    save(whole, path)


def require_equal(network: nn.Module, path: Path, crops: np.ndarray) -> float:
    """Run crops, float32 (N, 1, 48, 64), through the file and through PyTorch; return the largest difference. Raises
    EdgevprError if it is more than 1e-4."""
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    (got,) = session.run(["memorability"], {"crops": crops})
    with torch.no_grad():
        largest = float(np.abs(got - network(torch.from_numpy(crops)).numpy()).max())
    require_small(largest, path, "run the command again")
    return largest


def write_card(path: Path, model: Path, title: str, source: str) -> None:
    """Write the card of a network of matchability, `model`, to `path` beside it."""
    values = {
        "title": title,
        "file": model.name,
        "sha256": file_sha256(model),
        "licence": "MIT",
        "source": source,
        "input": {key: value for key, value in asdict(INPUT).items() if value is not None},
        "outputs": {"memorability": "memorability"},
    }
    path.write_text(card_text(values), encoding="utf-8")


def _small(graph: _Graph, network: Small) -> str:
    """Write the convolutions with their normalisation folded in."""
    at = "crops"
    layers = list(network.layers)
    for conv, norm in zip(layers[::3], layers[1::3], strict=True):
        gain = (norm.weight / torch.sqrt(norm.running_var + norm.eps)).detach()
        weight = graph.weight((conv.weight.detach() * gain[:, None, None, None]).numpy())
        bias = graph.weight((norm.bias - norm.running_mean * gain).detach().numpy())
        at = graph.add("Conv", at, weight, bias, kernel_shape=[3, 3], strides=[2, 2], pads=[1, 1, 1, 1])
        at = graph.add("Relu", at)
    return _linear(graph, graph.add("Flatten", graph.mean(at)), network.linear.weight, network.linear.bias)


def _statistics(graph: _Graph, network: Statistics) -> str:
    """Write the statistics one by one, with their normalisation folded into the regression."""

    def shifted(of: str, down: int, right: int) -> str:
        starts = graph.weight([down, right], np.int64)
        ends = graph.weight([_LAST if down else -1, _LAST if right else -1], np.int64)
        return graph.add("Slice", of, starts, ends, graph.weight([2, 3], np.int64))

    def log(of: str, more: float = 0.0) -> str:
        return graph.add("Log", graph.add("Add", of, graph.weight([more])))

    def squared(of: str) -> str:
        return graph.add("Mul", of, of)

    mean = graph.mean("crops")
    off = graph.add("Sub", "crops", mean)
    contrast = graph.add("Sqrt", graph.add("Add", graph.mean(squared(off)), graph.weight([network.NOISE**2])))
    even = graph.add("Div", off, contrast)
    said = [mean, log(contrast)]
    for scale in range(SCALES):
        here = shifted(even, 0, 0)
        steps = [graph.add("Sub", shifted(even, down, right), here) for down, right in ((1, 0), (0, 1))]
        strength = graph.add("Add", *map(squared, steps))
        usual = graph.add("Add", graph.mean(strength), graph.weight([FLOOR]))
        said.append(log(usual))
        if scale < UNEVEN_SCALES:
            uneven = graph.add("Div", graph.mean(squared(strength)), squared(usual))
            said.append(log(uneven, FLOOR))
        even = graph.add("AveragePool", even, kernel_shape=[2, 2], strides=[2, 2])
    flat = graph.add("Flatten", graph.add("Concat", *said, axis=1))
    deviation = torch.sqrt(network.norm.running_var + network.norm.eps)
    weight = network.linear.weight / deviation
    return _linear(graph, flat, weight, network.linear.bias - weight @ network.norm.running_mean)


def _linear(graph: _Graph, of: str, weight: torch.Tensor, bias: torch.Tensor) -> str:
    weights = graph.weight(weight.detach().numpy()), graph.weight(bias.detach().numpy())
    return graph.add("Gemm", of, *weights, transB=1)
