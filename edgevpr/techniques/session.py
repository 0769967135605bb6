"""Runs a network, from a picture to its outputs. This is the only module that uses onnxruntime in flight, imported with
the first network. A model file is not trusted: it is run once before the flight, and every result is checked."""

import os
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from edgevpr.core.arrays import Array, Image, Mask, Singles
from edgevpr.core.errors import ModelError, UsageError
from edgevpr.core.files import compute_sha256, read_file
from edgevpr.techniques.card import Card, InputRule, load_card

_OUTPUT_SHAPES = {"descriptor": (2, "(1, D)"), "features": (4, "(1, C, H, W)")}
_NOISE_SEED = 7
MAX_FILE_BYTES = 2**31  # protobuf, in which ONNX files are written, allows no more
_MAX_THREADS = 256
_MAX_VALUE = 1e12  # of much larger values the length of a vector overflows float32, and the unit vector is zero
_INTERPOLATIONS = {"area": cv2.INTER_AREA, "linear": cv2.INTER_LINEAR_EXACT, "cubic": cv2.INTER_CUBIC}


class Backbone:
    """One `output`, "features" or "descriptor", of the network of a `card`, which is run once on trial. `shape` is (C,
    H, W) for features, (D,) for a descriptor. `sha256` is the card's fingerprint: weights, preparation and outputs.

    Raises ModelError, one sentence, if onnxruntime or the card's file is missing, if the file is not that of the card
    or no ONNX, if inputs or outputs have another form or axes without a size, or if the result of the trial is not
    finite or all zeros. Raises UsageError for a number of threads outside 1 to 256.
    """

    def __init__(self, card: Card, output: str, threads: int = 1) -> None:
        if getattr(card.outputs, output) is None:
            raise ModelError(
                f"{card.path} names no output for `{output}`: use another model, or name its ONNX output in "
                f"`outputs: {{{output}: ...}}`."
            )
        self.card, self.output, self.sha256 = card, output, card.fingerprint
        self.session = open_session(card, threads)
        # Noise: for a uniform picture many correct networks give only zeros.
        noise = np.random.default_rng(_NOISE_SEED).integers(0, 256, (card.input.height, card.input.width), np.uint8)
        self.shape = self.run(noise).shape

    def run(self, image: Image, mask: Mask | None = None) -> Singles:
        """Run the network on uint8 (H, W[, 3]); returns float32 of `shape`. Pixels where bool (H, W) `mask` is False
        get the mean of the others. Raises ModelError for results with NaN, numbers beyond 1e12, or zeros only."""
        card, name = self.card, getattr(self.card.outputs, self.output)
        prepared = prepare_input(fill_masked(image, mask), card.input)
        (result,) = run_outputs(card, self.session, [name], prepared)
        rank, form = _OUTPUT_SHAPES[self.output]
        if result.ndim != rank or len(result) != 1 or not result.size:
            raise ModelError(
                f"{card.file_path}: its output `{name}` is {result.shape} and `{self.output}` must be {form}: correct "
                "`outputs` of the card."
            )
        values: Singles = result[0].astype(np.float32, copy=False)
        if not values.any():
            raise ModelError(
                f"{card.file_path} gives only zeros for `{name}`: correct its weights or `input` of its card, unless "
                "the picture is blank."
            )
        return values


def open_backbone(model: str, output: str, threads: int = 1) -> Backbone:
    """Open the network of the card called `model`; raises as `Backbone` and `load_card` do."""
    return Backbone(load_card(model), output, threads)


def open_session(card: Card, threads: int = 1) -> Any:
    """Open the onnxruntime session of a card's file; raises as `Backbone` does. The network is not run, so its inputs
    and outputs are not yet compared with the card."""
    if not 1 <= threads <= _MAX_THREADS:
        raise UsageError(f"{card.name} cannot run with threads={threads}: give 1 to {_MAX_THREADS}.")
    return _load_session(card.file_path, card.sha256, threads)


def hash_model_file(path: Path) -> str:
    """Compute the SHA-256 of a model file, 64 hexadecimal digits. Raises ModelError if it cannot be read."""
    try:
        return compute_sha256(path, MAX_FILE_BYTES)
    except OSError as error:
        raise ModelError(
            f"{path} cannot be read ({error.strerror}): put the weights there, or remove the card."
        ) from error


@cache
def _load_session(path: Path, sha256: str, threads: int) -> Any:
    """Check the hash of a network's file and open its session, one in the process for all techniques that use it."""
    file_sha256 = hash_model_file(path)
    if file_sha256 != sha256:
        raise ModelError(
            f"{path} is not the file of its card: its SHA-256 is {file_sha256} and the card says {sha256}; get the "
            "right file, or correct the card."
        )
    runtime = import_onnxruntime()
    options = runtime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = 4  # fatal messages only: edgevpr reports errors itself
    # Threads that wait for work by spinning draw power and do nothing.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # Weights in a second file are refused, since the hash does not cover them. For a model given as bytes onnxruntime
    # would search the working directory for them, so a folder is named that does not exist.
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", str(path))
    try:
        return runtime.InferenceSession(read_file(path, MAX_FILE_BYTES), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own classes, and RuntimeError
        raise ModelError(
            f"{path} cannot be opened as an ONNX model with its weights inside ({_join_lines(error)}): export it again."
        ) from error


def import_onnxruntime() -> Any:
    """Import onnxruntime and return it. Raises ModelError if it cannot be imported."""
    # Else it reports its use to its maker, and keeps a file for that in the home folder (1.31 and 1.32).
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    try:
        import onnxruntime
    except Exception as error:  # a broken installation raises OSError, or an error of NumPy
        raise ModelError(
            f"onnxruntime cannot be imported ({_join_lines(error)}): install it again (`pip install onnxruntime`) for "
            "the techniques with networks; hog, cohog and seqslam fly without it."
        ) from error
    return onnxruntime


def run_outputs(card: Card, session: Any, names: list[str], pictures: Singles) -> list[Array]:
    """Run a session of `open_session` on prepared pictures, float32 (N, ...). Returns the outputs, ordered as `names`.
    Raises ModelError for a run that fails, and for numbers that are not finite or beyond 1e12."""
    try:
        results: list[Array] = session.run(names, {session.get_inputs()[0].name: pictures})
    except Exception as error:  # onnxruntime's own classes, and RuntimeError
        raise ModelError(
            f"{card.file_path} cannot be run as its card says ({_join_lines(error)}): correct `input` or `outputs` of "
            "the card, or export the network for it."
        ) from error
    for name, result in zip(names, results, strict=True):
        if result.dtype.kind != "f":
            raise ModelError(f"{card.file_path}: its output `{name}` is {result.dtype}: it must be float.")
        # Written with `not`, so that NaN is refused as well.
        if result.size and not max(result.max(), -result.min()) <= _MAX_VALUE:
            raise ModelError(
                f"{card.file_path} gives numbers that are not finite, or beyond {_MAX_VALUE:g}, for `{name}`: correct "
                "its weights or `input` of its card."
            )
    return results


def _join_lines(error: Exception) -> str:
    return " ".join((str(error) or type(error).__name__).split())[:200]


def prepare_input(image: Array, rule: InputRule) -> Singles:
    """Convert a picture, uint8 (H, W) grey or (H, W, 3) BGR, to the input that `rule` describes: float32 (1, C, height,
    width). Histogram equalisation is that of CALC: of Y of the picture as YUV, before it is made grey and smaller."""
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
    across, down = compute_fill_shares(image, rule)
    width, height = round(across * rule.width), round(down * rule.height)
    image = cv2.resize(image, (width, height), interpolation=_INTERPOLATIONS[rule.resize])
    if rule.pad is not None:
        border = (0, rule.height - height, 0, rule.width - width)
        image = cv2.copyMakeBorder(image, *border, cv2.BORDER_CONSTANT, value=(rule.pad,) * 3)
    values = np.multiply(image, np.float32(rule.scale), dtype=np.float32).reshape(rule.height, rule.width, -1)
    values -= np.array(rule.mean, np.float32)
    if rule.std is not None:
        values /= np.array(rule.std, np.float32)
    return np.ascontiguousarray(values.transpose(2, 0, 1)[None])


def compute_fill_shares(image: Array, rule: InputRule) -> tuple[float, float]:
    """Return the shares, 0..1, of the network input's width and of its height that `prepare_input` fills with the
    picture; the rest is padding."""
    if rule.pad is None:
        return 1.0, 1.0
    height, width = image.shape[:2]
    scale = min(rule.width / width, rule.height / height)
    return max(1, round(width * scale)) / rule.width, max(1, round(height * scale)) / rule.height


def fill_masked(image: Image, mask: Mask | None) -> Array:
    """Set every pixel where the bool (H, W) `mask` is False to the mean of the others (128 if there are none): a
    uniform patch affects the output of a network least."""
    if mask is None or mask.all():
        return image
    filled = image.copy()
    filled[~mask] = np.rint(image[mask].mean(axis=0)) if mask.any() else 128
    return filled
