"""ONNX files of a few hundred bytes, whole and broken, with their cards."""

import hashlib
import json
from pathlib import Path

import numpy as np
from onnx import TensorProto, helper, numpy_helper, save

HEIGHT = 24
WIDTH = 32
FEATURES = (4, 10, 14)
CARD = {
    "title": "A tiny network",
    "file": "tiny.onnx",
    "licence": "MIT",
    "source": "made by a test",
    "input": {
        "layout": "NCHW",
        "height": HEIGHT,
        "width": WIDTH,
        "colour": "grey",
        "equalise": False,
        "resize": "area",
        "scale": 1 / 255,
        "mean": [0.5],
    },
    "outputs": {"descriptor": "descriptor", "features": "features"},
    "similarity": "cosine",
}


def write_network(folder: Path, name: str = "tiny", fault: str | None = None, card: dict | None = None) -> Path:
    """Write NAME.onnx and NAME.yaml, with a `fault` of the file or other keys on the `card`; returns the card."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{name}.onnx"
    if fault == "no onnx":
        file.write_text("this is a letter to the pilot")
    else:
        save(_network(fault), str(file), save_as_external_data=fault == "weights outside", size_threshold=0)
    sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
    return write_card(folder / f"{name}.yaml", {"file": file.name, "sha256": sha256, **(card or {})})


def write_card(path: Path, changes: dict) -> Path:
    """The card `CARD` with some keys changed. JSON is YAML."""
    path.write_text("".join(f"{key}: {json.dumps(value)}\n" for key, value in {**CARD, **changes}.items()))
    return path


def _network(fault: str | None):
    weights = np.random.default_rng(1).normal(0, 0.3, (FEATURES[0], 1, 5, 5)).astype(np.float32)
    bias = np.full(FEATURES[0], 0.2, np.float32)
    if fault == "nan":
        weights[1, 0, 2, 2] = np.nan
    if fault == "zeros":
        weights[:], bias[:] = 0, -1
    if fault == "below zero in the dark":
        bias[:] = -0.2
    size: list = [1, 1, HEIGHT, WIDTH]
    if fault == "dynamic batch":
        size[0] = "batch"
    if fault == "other size":
        size = [1, 1, HEIGHT, WIDTH + 8]
    nodes = [
        helper.make_node("Conv", ["picture", "weights", "bias"], ["conv"], strides=[2, 2]),
        helper.make_node("Identity" if fault == "below zero in the dark" else "Relu", ["conv"], ["features"]),
        helper.make_node("AveragePool", ["features"], ["pooled"], kernel_shape=[5, 7], strides=[5, 7]),
        helper.make_node("Flatten", ["pooled"], ["descriptor"]),
    ]
    inputs = [helper.make_tensor_value_info("picture", TensorProto.FLOAT, size)]
    outputs = [helper.make_tensor_value_info(each, TensorProto.FLOAT, None) for each in ("descriptor", "features")]
    initial = [numpy_helper.from_array(weights, "weights"), numpy_helper.from_array(bias, "bias")]
    graph = helper.make_graph(nodes, "tiny", inputs, outputs, initial)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
