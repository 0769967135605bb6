"""Export of a trained encoder as ONNX file and card. The file is written node by node: the same for every PyTorch."""

import json
import math
from pathlib import Path

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

from edgevpr.core.errors import EdgevprError
from edgevpr.lab.training.network import CODE, FEATURES, LRN_ALPHA, LRN_BETA, LRN_SIZE, Encoder
from edgevpr.lab.training.pictures import HEIGHT, WIDTH
from edgevpr.techniques.session import file_sha256

LARGEST_DIFFERENCE = 1e-4
_OPSET = 13


def write_onnx(encoder: Encoder, path: Path) -> None:
    """Write a folded encoder: `image` (1, 1, 120, 160) -> `descriptor` (1, 1064) of length 1 and `features`
    (1, 128, 16, 21), all float32."""
    lrn = {"size": LRN_SIZE, "alpha": LRN_ALPHA, "beta": LRN_BETA, "bias": 1.0}
    pool = {"kernel_shape": [3, 3], "strides": [2, 2], "ceil_mode": 1}

    def conv(name: str, source: str, target: str) -> onnx.NodeProto:
        layer = getattr(encoder, name)
        return helper.make_node(
            "Conv",
            [source, f"{name}.weight", f"{name}.bias"],
            [target],
            kernel_shape=list(layer.kernel_size),
            strides=list(layer.stride),
            pads=2 * list(layer.padding),
        )

    nodes = [
        conv("conv1", "image", "c1"),
        helper.make_node("Relu", ["c1"], ["r1"]),
        helper.make_node("MaxPool", ["r1"], ["p1"], **pool),
        helper.make_node("LRN", ["p1"], ["n1"], **lrn),
        conv("conv2", "n1", "c2"),
        helper.make_node("Relu", ["c2"], ["r2"]),
        helper.make_node("MaxPool", ["r2"], ["p2"], **pool),
        helper.make_node("LRN", ["p2"], ["features"], **lrn),
        conv("conv3", "features", "c3"),
        helper.make_node("Relu", ["c3"], ["r3"]),
        helper.make_node("Flatten", ["r3"], ["code"], axis=1),
        helper.make_node("LpNormalization", ["code"], ["descriptor"], axis=1, p=2),
    ]
    weights = [
        numpy_helper.from_array(np.ascontiguousarray(value.numpy()), name)
        for name, value in encoder.state_dict().items()
    ]
    graph = helper.make_graph(
        nodes,
        "calc",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [1, 1, HEIGHT, WIDTH])],
        [
            helper.make_tensor_value_info("descriptor", TensorProto.FLOAT, [1, math.prod(CODE)]),
            helper.make_tensor_value_info("features", TensorProto.FLOAT, [1, *FEATURES]),
        ],
        weights,
    )
    save(graph, path)


def save(graph: onnx.GraphProto, path: Path) -> None:
    """Check a graph and write it as an ONNX file that every onnxruntime since 1.17 reads."""
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], producer_name="edgevpr")
    model.ir_version = 8  # a version that onnxruntime 1.17 reads
    onnx.checker.check_model(model, full_check=True)
    path.write_bytes(model.SerializeToString())


def require_equal(encoder: Encoder, path: Path, inputs: np.ndarray) -> float:
    """Run `inputs`, float32 (N, 1, 120, 160), through the file and through PyTorch; return the largest difference, as a
    share of the largest value (of 1, if that is larger).

    Raises EdgevprError if the difference is more than 1e-4.
    """
    import onnxruntime

    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    largest = 0.0
    for image in inputs[:, None]:
        with torch.no_grad():
            wanted = [value.numpy() for value in encoder(torch.from_numpy(image))]
        for got, want in zip(session.run(["descriptor", "features"], {"image": image}), wanted, strict=True):
            largest = max(largest, float(np.abs(got - want).max() / max(1.0, np.abs(want).max())))
    require_small(largest, path, "run the command again with --resume")
    return largest


def require_small(largest: float, path: Path, then: str) -> None:
    """Raise EdgevprError, with what to do `then`, if a file differs from PyTorch by more than 1e-4."""
    if not largest <= LARGEST_DIFFERENCE:
        raise EdgevprError(
            f"{path} gives other values than PyTorch (they differ by {largest:.2g}): install another version of onnx "
            f"or torch and {then}."
        )


def write_card(path: Path, model: Path, title: str, source: str) -> None:
    """Write the card of a CALC model, `model`, to `path` beside it."""
    sha256 = file_sha256(model)
    path.write_text(
        f"title: {json.dumps(title)}\n"
        f"file: {json.dumps(model.name)}\n"
        f"sha256: {json.dumps(sha256)}\n"
        "licence: MIT\n"
        f"source: {json.dumps(source)}\n"
        f"input: {{layout: NCHW, height: {HEIGHT}, width: {WIDTH}, colour: grey, equalise: true, resize: cubic, "
        f"scale: {1 / 255!r}, mean: [0.0]}}\n"
        "outputs: {descriptor: descriptor, features: features}\n"
        "head: null\n"
        "similarity: cosine\n",
        encoding="utf-8",
    )
