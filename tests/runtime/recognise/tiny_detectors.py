"""Detectors and networks of memorability that answer alike to every picture, or with its brightness: a few hundred
bytes of ONNX with their cards."""

import hashlib
import json
from pathlib import Path

import numpy as np
from onnx import TensorProto, checker, helper, numpy_helper

SIDE_PX = 64
CELLS = 84  # of 64x64 pixels under strides of 8, 16 and 32
DYNAMIC = {"person": 0, "car": 2}


def write_detector(folder: Path, boxes_px=(), *, raw=None, family="yolox", name="tiny", pad=None, scores=None) -> Path:
    """Write a detector of the family of YOLOX that finds these boxes, (left, top, right, bottom, class), in every
    picture of 64x64 pixels. `raw` is put out instead."""
    if raw is None:
        raw = np.zeros((1, CELLS, 5 + 4), np.float32)
        for at, (left, top, right, bottom, number) in enumerate(boxes_px):
            row, column = divmod(at, SIDE_PX // 8)
            raw[0, at, :2] = (left + right) / 16 - column, (top + bottom) / 16 - row
            raw[0, at, 2:4] = np.log([(right - left) / 8, (bottom - top) / 8])
            raw[0, at, 4] = raw[0, at, 5 + number] = 1
    return _write(folder, name, _constant(raw), _card("boxes", family, pad))


def write_memorability(folder: Path, *, name="bright", gain=1.0, batch=True) -> Path:
    """Write a network that says of a picture how bright it is, 0..1, times `gain`."""
    nodes = [
        helper.make_node("ReduceMean", ["image"], ["mean"], axes=[2, 3], keepdims=0),
        helper.make_node("Mul", ["mean", "gain"], ["said"]),
    ]
    return _write(
        folder,
        name,
        (nodes, [numpy_helper.from_array(np.array([gain], np.float32), "gain")], [None, 1]),
        {"outputs": {"memorability": "said"}},
        batch=batch,
    )


def _constant(raw):
    zero = numpy_helper.from_array(np.zeros(1, np.float32), "zero")
    nodes = [
        helper.make_node("ReduceMean", ["image"], ["mean"], keepdims=0),
        helper.make_node("Mul", ["mean", "zero"], ["nothing"]),
        helper.make_node("Add", ["raw", "nothing"], ["said"]),
    ]
    return nodes, [zero, numpy_helper.from_array(raw, "raw")], list(raw.shape)


def _card(output, family, pad):
    rule = {"family": family, "min_score": 0.5, "dynamic": DYNAMIC}
    return {"outputs": {output: ["said"]}, "detector": rule, "pad": pad}


def _write(folder, name, graph, said, batch=False):
    folder.mkdir(parents=True, exist_ok=True)
    nodes, weights, shape = graph
    model = helper.make_model(
        helper.make_graph(
            nodes,
            name,
            [helper.make_tensor_value_info("image", TensorProto.FLOAT, ["n" if batch else 1, 1, SIDE_PX, SIDE_PX])],
            [helper.make_tensor_value_info("said", TensorProto.FLOAT, shape)],
            weights,
        ),
        opset_imports=[helper.make_opsetid("", 13)],
    )
    model.ir_version = 8
    checker.check_model(model)
    file = folder / f"{name}.onnx"
    file.write_bytes(model.SerializeToString())
    picture = {"layout": "NCHW", "height": SIDE_PX, "width": SIDE_PX, "colour": "grey", "equalise": False}
    picture |= {"resize": "area", "scale": 1 / 255, "mean": [0.0], "pad": said.pop("pad", None)}
    card = {
        "title": "Tiny",
        "file": file.name,
        "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        "licence": "MIT",
        "source": "made by a test",
        "input": picture,
        **said,
    }
    path = folder / f"{name}.yaml"
    path.write_text(json.dumps(card))  # JSON is YAML
    return path
