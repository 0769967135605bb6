"""Writes a network of PyTorch as an ONNX file with its card, checked against PyTorch."""

import json
import logging
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import torch

from edgevpr.core.arrays import Singles
from edgevpr.core.errors import EdgevprError
from edgevpr.techniques.card import InputRule
from edgevpr.techniques.session import hash_model_file

LARGEST_DIFFERENCE = 1e-4
_OPSET, _IR_VERSION = 18, 8  # that every onnxruntime since 1.17 reads


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelFile:
    """An ONNX file to be made, and its card, which has `title` and `source`. `input` is the name of the network's input
    and `rule` the preparation of a picture. `outputs` are the names of the network's outputs by the key of the card,
    such as "descriptor"."""

    path: Path
    title: str
    source: str
    input: str
    rule: InputRule
    outputs: dict[str, str]


def write_model(file: ModelFile, network: torch.nn.Module, samples: Sequence[Singles]) -> float:
    """Write a network and its card. Each of `samples` is an input to compare with, float32 (N, ...). If N > 1 in the
    first, the file takes any number of pictures.

    Returns the largest difference between the outputs of the file and of PyTorch, as a share of the largest value (of
    1, if that is larger). If it is more than 1e-4, deletes the file and raises EdgevprError.
    """
    _write_onnx(file, network, samples[0])
    largest = _largest_difference(file, network, samples)
    if not largest <= LARGEST_DIFFERENCE:
        file.path.unlink()  # a wrong file must not be taken for a model
        raise EdgevprError(
            f"{file.path} gives other values than PyTorch (they differ by {largest:.2g}): install another version of "
            "onnx or torch and run the command again."
        )
    values = {
        "title": file.title,
        "file": file.path.name,
        "sha256": hash_model_file(file.path),
        "licence": "MIT",
        "source": file.source,
        "input": {key: value for key, value in asdict(file.rule).items() if value is not None},
        "outputs": file.outputs,
    }
    card = "".join(f"{key}: {json.dumps(value, ensure_ascii=False)}\n" for key, value in values.items())  # JSON is YAML
    file.path.with_suffix(".yaml").write_text(card, encoding="utf-8")
    return largest


def _write_onnx(file: ModelFile, network: torch.nn.Module, sample: Singles) -> None:
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # its warnings are about packages that are not needed
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # those of PyTorch about PyTorch
        program = torch.onnx.export(
            network,
            (torch.from_numpy(sample),),
            dynamo=True,
            verbose=False,
            input_names=[file.input],
            output_names=list(file.outputs.values()),
            dynamic_shapes=({0: torch.export.Dim("n")},) if len(sample) > 1 else None,
            opset_version=_OPSET,
        )
    assert program is not None  # with dynamo
    model = program.model_proto
    model.ir_version, model.producer_name = _IR_VERSION, "edgevpr"
    onnx.checker.check_model(model, full_check=True)
    file.path.write_bytes(model.SerializeToString())


def _largest_difference(file: ModelFile, network: torch.nn.Module, samples: Sequence[Singles]) -> float:
    session = onnxruntime.InferenceSession(str(file.path), providers=["CPUExecutionProvider"])
    differences = []
    for sample in samples:
        with torch.no_grad():
            result = network(torch.from_numpy(sample))
        wanted = [value.numpy() for value in (result if isinstance(result, tuple) else (result,))]
        found = session.run(list(file.outputs.values()), {file.input: sample})
        differences += [np.abs(a - b).max() / max(1, np.abs(b).max()) for a, b in zip(found, wanted, strict=True)]
    return float(np.max(differences))
