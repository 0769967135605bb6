"""Tiny ONNX detectors and networks of memorability that answer alike to every picture, or with its brightness."""

import hashlib
from pathlib import Path

import numpy as np
from onnx import TensorProto, checker, helper, numpy_helper
from tiny_networks import CARD, write_card

SIDE_PX = 64
CELLS = 84  # of 64x64 pixels under strides of 8, 16 and 32
DYNAMIC = {"person": 0, "car": 2}


def write_detector(folder: Path, boxes_px=(), *, raw=None, pad=None) -> Path:
    """Write a detector `tiny` of the family of YOLOX that finds these boxes, (left, top, right, bottom, class), in
    every picture of 64x64 pixels. `raw` is put out instead."""
    if raw is None:
        raw = np.zeros((1, CELLS, 5 + 4), np.float32)
        for at, (left, top, right, bottom, number) in enumerate(boxes_px):
            row, column = divmod(at, SIDE_PX // 8)
            raw[0, at, :2] = (left + right) / 16 - column, (top + bottom) / 16 - row
            raw[0, at, 2:4] = np.log([(right - left) / 8, (bottom - top) / 8])
            raw[0, at, 4] = raw[0, at, 5 + number] = 1
    nodes = [
        helper.make_node("ReduceMean", ["image"], ["mean"], keepdims=0),
        helper.make_node("Mul", ["mean", "zero"], ["nothing"]),
        helper.make_node("Add", ["raw", "nothing"], ["said"]),
    ]
    rule = {"family": "yolox", "min_score": 0.5, "dynamic": DYNAMIC}
    card = {"outputs": {"boxes": ["said"]}, "detector": rule, "input": {"pad": pad}}
    return _write(folder, "tiny", nodes, {"zero": np.zeros(1, np.float32), "raw": raw}, [1, *raw.shape], card)


def write_memorability(folder: Path, gain=1.0) -> Path:
    """Write a network `bright` that says of a picture how bright it is, 0..1, times `gain`."""
    nodes = [
        helper.make_node("ReduceMean", ["image"], ["mean"], axes=[2, 3], keepdims=0),
        helper.make_node("Mul", ["mean", "gain"], ["said"]),
    ]
    weights = {"gain": np.array([gain], np.float32)}
    return _write(folder, "bright", nodes, weights, ["n", None, 1], {"outputs": {"memorability": "said"}, "input": {}})


def _write(folder, name, nodes, weights, sizes, card):
    """Write a network and its card. `sizes` are that of a batch, and of each axis of the output."""
    batch, *shape = sizes
    graph = helper.make_graph(
        nodes,
        name,
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, [batch, 1, SIDE_PX, SIDE_PX])],
        [helper.make_tensor_value_info("said", TensorProto.FLOAT, shape)],
        [numpy_helper.from_array(values, of) for of, values in weights.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    checker.check_model(model)
    file = folder / f"{name}.onnx"
    file.write_bytes(model.SerializeToString())
    picture = CARD["input"] | {"height": SIDE_PX, "width": SIDE_PX, "mean": [0.0]} | card["input"]
    sha256 = hashlib.sha256(file.read_bytes()).hexdigest()
    return write_card(folder / f"{name}.yaml", card | {"file": file.name, "sha256": sha256, "input": picture})
