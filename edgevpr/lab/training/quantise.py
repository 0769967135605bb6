"""`edgevpr models quantise`: a network in 8-bit integers, a quarter of the size, faster where bytes are fast."""

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from edgevpr.core.errors import ModelError
from edgevpr.core.files import own_models
from edgevpr.core.yamlfile import read_yaml
from edgevpr.frames.images import list_images, read_image
from edgevpr.runtime.preflight.networks import Verified, card_text, install, verify
from edgevpr.techniques.card import load_card, read_card
from edgevpr.techniques.session import backbone_of, file_sha256, prepare

_MOST_IMAGES = 200


@dataclass(frozen=True, slots=True)
class Quantised:
    """Result of quantising a network: the path of the new card, the number of images used for calibration, and the
    results of trying the network on this machine `before` and `after`."""

    card: str
    images: int
    before: Verified
    after: Verified


def quantise(name: str, calibration: Path, threads: int = 1) -> Quantised:
    """Write the network of the card `name` in 8-bit integers (static INT8), as NAME_int8, to the user's models folder.

    The ranges of its activations are measured on at most 200 images of the folder `calibration`. Raises ModelError if
    `onnx` is missing or the network cannot be quantised, SourceError for a folder without images.
    """
    card = load_card(name)
    before = verify(card, threads)
    backbone = backbone_of(card, "descriptor" if card.outputs.descriptor else "features", threads)
    paths = list_images(calibration)
    chosen = paths[:: -(-len(paths) // _MOST_IMAGES)]
    picture = backbone.session.get_inputs()[0].name
    values = read_yaml(card.path)
    values["title"], values["file"] = f"{card.title}; INT8 by edgevpr models quantise", f"{name}_int8.onnx"
    with TemporaryDirectory(prefix="edgevpr-quantise-") as folder:
        made = Path(folder) / values["file"]
        _quantised(card.file_path, made, ({picture: prepare(read_image(path), card.input)} for path in chosen))
        values["sha256"] = file_sha256(made)
        trial, text = made.with_suffix(".yaml"), card_text(values)
        trial.write_text(text, "utf-8")
        after = verify(read_card(trial), threads)
        target = own_models() / trial.name
        install(made, values["sha256"], target, made.name, text)
    return Quantised(str(target), len(chosen), before, after)


def _quantised(source: Path, target: Path, feeds: Any) -> None:
    try:
        import onnx  # noqa: F401 (onnxruntime.quantization fails without it, with a long message)
        from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static
        from onnxruntime.quantization.shape_inference import quant_pre_process
    except ImportError as error:
        raise ModelError(
            f'Quantising needs the package `onnx` ({error}): pip install "edgevpr[train]" on a workstation, and copy '
            "what it writes to the board."
        ) from error

    pictures = type("Pictures", (CalibrationDataReader,), {"get_next": lambda _: next(feeds, None)})
    prepared = target.with_name("prepared.onnx")
    try:
        quant_pre_process(str(source), str(prepared), skip_symbolic_shape=True)
        quantize_static(
            str(prepared),
            str(target),
            pictures(),
            quant_format=QuantFormat.QDQ,
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
        )
    except Exception as error:  # errors of onnx, protobuf and onnxruntime have no common class
        said = (str(error).strip() or type(error).__name__).splitlines()[0][:200]
        raise ModelError(f"{source} cannot be quantised ({said}): use it as it is.") from error
