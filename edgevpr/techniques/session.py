"""Runs a network on an image and returns its outputs. Only this module uses onnxruntime in flight, and imports it for
the first network. A model file is not trusted: it is run once before the flight, and every result is checked."""

import hashlib
import os
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from edgevpr.core.arrays import Array, Image, Mask, Singles
from edgevpr.core.errors import ModelError, UsageError
from edgevpr.core.files import open_file, read_file
from edgevpr.techniques.card import Card, InputRule, load_card

_OUTPUT_SHAPES = {"descriptor": (2, "(1, D)"), "features": (4, "(1, C, H, W)")}
_NOISE_SEED = 7
MAX_FILE_BYTES = 2**31  # limit of protobuf, the format of ONNX files
_MAX_THREADS = 256
_MAX_VALUE = 1e12  # the norm of a vector of much larger values overflows float32, and its unit vector is zero
_INTERPOLATIONS = {"area": cv2.INTER_AREA, "linear": cv2.INTER_LINEAR_EXACT, "cubic": cv2.INTER_CUBIC}


class Backbone:
    """One `output`, "features" or "descriptor", of the network of a `card`, which is run once to check it. `shape` is
    (C, H, W) for features, (D,) for a descriptor. `sha256` is the card's fingerprint: weights, preparation and outputs.

    Raises ModelError, with a message of one sentence, if onnxruntime or the card's file is missing, if the file does
    not match the card or is not ONNX, if an input or output has the wrong shape or an axis without a size, or if the
    check yields non-finite values or only zeros. Raises UsageError unless `threads` is 1 to 256."""

    def __init__(self, card: Card, output: str, threads: int = 1) -> None:
        if getattr(card.outputs, output) is None:
            raise ModelError(
                f"{card.path} lists no output for `{output}`: use another model, or add the name of its ONNX output "
                f"to the card as `outputs: {{{output}: ...}}`."
            )
        self.card, self.output, self.sha256 = card, output, card.fingerprint
        self.session = open_session(card, threads)
        # Use noise, because many correct networks output only zeros for a uniform image.
        noise = np.random.default_rng(_NOISE_SEED).integers(0, 256, (card.input.height, card.input.width), np.uint8)
        self.shape = self.run(noise).shape

    def run(self, image: Image, mask: Mask | None = None) -> Singles:
        """Run the network on uint8 (H, W[, 3]); returns float32 of `shape`. Pixels where `mask`, bool (H, W), is False
        are set to the mean of the others. Raises ModelError for NaN, values beyond 1e12, or only zeros."""
        card, name = self.card, getattr(self.card.outputs, self.output)
        (result,) = run_outputs(card, self.session, [name], prepare_input(fill_masked(image, mask), card.input))
        rank, shape_text = _OUTPUT_SHAPES[self.output]
        if result.ndim != rank or len(result) != 1 or not result.size:
            raise ModelError(
                f"{card.file_path}: the shape of its output `{name}` is {result.shape}, but `{self.output}` must be "
                f"{shape_text}: correct `outputs` in the card."
            )
        values: Singles = result[0].astype(np.float32, copy=False)
        if not values.any():
            raise ModelError(
                f"{card.file_path} outputs only zeros for `{name}`: correct its weights or the `input` section of its "
                "card, unless the picture is blank."
            )
        return values


def open_backbone(model: str, output: str, threads: int = 1) -> Backbone:
    """Open the network of the card `model`. Raises the errors of `Backbone` and `load_card`."""
    return Backbone(load_card(model), output, threads)


def open_session(card: Card, threads: int = 1) -> Any:
    """Open the onnxruntime session of a card's file. The network is not run, so its inputs and outputs are not yet
    checked against the card. Raises the errors of `Backbone`."""
    if not 1 <= threads <= _MAX_THREADS:
        raise UsageError(f"{card.name} cannot run with threads={threads}: use 1 to {_MAX_THREADS}.")
    return _load_session(card.file_path, card.sha256, threads)


def hash_model_file(path: Path) -> str:
    """Compute the SHA-256 of a model file, 64 hexadecimal digits. Raises ModelError if it cannot be read."""
    digest = hashlib.sha256()
    try:
        with open_file(path, MAX_FILE_BYTES) as handle:
            while block := handle.read(1 << 20):
                digest.update(block)
    except OSError as error:
        raise ModelError(
            f"{path} cannot be read ({error.strerror}): put the weights there, or remove the card."
        ) from error
    return digest.hexdigest()


@cache
def _load_session(path: Path, sha256: str, threads: int) -> Any:
    """Check the hash of a network's file and open its session, which all techniques of this process share."""
    file_sha256 = hash_model_file(path)
    if file_sha256 != sha256:
        raise ModelError(
            f"{path} does not match its card: its SHA-256 is {file_sha256}, but the card expects {sha256}: get the "
            "right file, or correct the card."
        )
    runtime = import_onnxruntime()
    options = runtime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = 4  # only fatal messages, because edgevpr reports errors itself
    # Threads that spin while they wait for work waste power.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # Reject weights in a second file, because the hash does not cover them. For a model passed as bytes, onnxruntime
    # would look for that file in the working directory, so set a folder that does not exist.
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", str(path))
    try:
        return runtime.InferenceSession(read_file(path, MAX_FILE_BYTES), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own classes, and RuntimeError
        raise ModelError(
            f"{path} cannot be opened as an ONNX model with embedded weights ({_join_lines(error)}): export it again."
        ) from error


def import_onnxruntime() -> Any:
    """Import onnxruntime and return it. Raises ModelError if it cannot be imported."""
    # Otherwise onnxruntime 1.31 and 1.32 send telemetry to the vendor and keep a file for it in the home folder.
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    try:
        import onnxruntime
    except Exception as error:  # a broken installation raises OSError or a NumPy error
        raise ModelError(
            f"onnxruntime cannot be imported ({_join_lines(error)}): reinstall it (`pip install onnxruntime`) to use "
            "the neural-network techniques; hog, cohog and seqslam work without it."
        ) from error
    return onnxruntime


def run_outputs(card: Card, session: Any, names: list[str], pictures: Singles) -> list[Array]:
    """Run a session of `open_session` on prepared images, float32 (N, ...). Returns the outputs in the order of
    `names`. Raises ModelError if the run fails, or if a value is not finite or is beyond 1e12."""
    try:
        results: list[Array] = session.run(names, {session.get_inputs()[0].name: pictures})
    except Exception as error:  # onnxruntime's own classes, and RuntimeError
        raise ModelError(
            f"{card.file_path} cannot be run as described in its card ({_join_lines(error)}): correct `input` or "
            "`outputs` in the card, or re-export the network to match it."
        ) from error
    for name, result in zip(names, results, strict=True):
        if result.dtype.kind != "f":
            raise ModelError(f"{card.file_path}: its output `{name}` is {result.dtype}, but it must be float.")
        # Written with `not` so that NaN is rejected too.
        if result.size and not max(result.max(), -result.min()) <= _MAX_VALUE:
            raise ModelError(
                f"{card.file_path} outputs values that are not finite, or beyond {_MAX_VALUE:g}, for `{name}`: correct "
                "its weights or the `input` section of its card."
            )
    return results


def _join_lines(error: Exception) -> str:
    return " ".join((str(error) or type(error).__name__).split())[:200]


def prepare_input(image: Array, rule: InputRule) -> Singles:
    """Convert an image, uint8 (H, W) grey or (H, W, 3) BGR, to the input that `rule` describes: float32 (1, C, height,
    width). Histogram equalisation follows CALC: Y of the YUV image, before conversion to grey and resizing."""
    if rule.equalise and image.ndim == 2:
        image = cv2.equalizeHist(image)
    elif rule.equalise:
        yuv: Array = cv2.cvtColor(image, cv2.COLOR_BGR2YUV)
        yuv[..., 0] = cv2.equalizeHist(np.ascontiguousarray(yuv[..., 0]))
        image = cv2.cvtColor(yuv, cv2.COLOR_YUV2BGR)
    if rule.colour == "grey":
        image = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    elif image.ndim == 2:
        image = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    elif rule.colour == "rgb":
        image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    width_fraction, height_fraction = compute_fill_fractions(image, rule)
    width, height = round(width_fraction * rule.width), round(height_fraction * rule.height)
    image = cv2.resize(image, (width, height), interpolation=_INTERPOLATIONS[rule.resize])
    if rule.pad is not None:
        border = (0, rule.height - height, 0, rule.width - width)
        image = cv2.copyMakeBorder(image, *border, cv2.BORDER_CONSTANT, value=(rule.pad,) * 3)
    values = np.multiply(image, np.float32(rule.scale), dtype=np.float32).reshape(rule.height, rule.width, -1)
    values -= np.array(rule.mean, np.float32)
    if rule.std is not None:
        values /= np.array(rule.std, np.float32)
    return np.ascontiguousarray(values.transpose(2, 0, 1)[None])


def compute_fill_fractions(image: Array, rule: InputRule) -> tuple[float, float]:
    """Return the fractions, 0..1, of the width and the height of the network's input that `prepare_input` fills with
    the image; the rest is padding."""
    if rule.pad is None:
        return 1.0, 1.0
    height, width = image.shape[:2]
    scale = min(rule.width / width, rule.height / height)
    return max(1, round(width * scale)) / rule.width, max(1, round(height * scale)) / rule.height


def fill_masked(image: Image, mask: Mask | None) -> Array:
    """Set every pixel where `mask`, bool (H, W), is False to the mean of the others (128 if there are none). A uniform
    patch affects the network's output least."""
    if mask is None or mask.all():
        return image
    filled = image.copy()
    filled[~mask] = np.rint(image[mask].mean(axis=0)) if mask.any() else 128
    return filled
