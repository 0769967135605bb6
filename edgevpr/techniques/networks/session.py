"""Running a network: the only module that uses onnxruntime in flight, and imports it only with the first network.

A model file is not trusted: it is run once before it may fly, and every result is checked.
"""

import os
import threading
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr.core.errors import ModelError, UsageError
from edgevpr.core.files import read_file, sha256_of
from edgevpr.techniques.networks.card import Card, load_card
from edgevpr.techniques.networks.prepare import prepare, without_masked

_RANKS = {"descriptor": 2, "features": 4}
_FORMS = {"descriptor": "(1, D)", "features": "(1, C, H, W)"}
_SEED = 7
MAX_FILE_BYTES = 2**31  # protobuf, in which ONNX files are written, allows no more
_RUN_LIMIT_S = 30.0  # of one picture: half of what the watchdog of systemd allows a flight to be silent
_MOST_THREADS = 256
_LARGEST = 1e12  # with much larger numbers the length of a vector overflows float32, and the unit vector is zero


class Backbone:
    """One output of a network that has run successfully. `shape` is (C, H, W) of features, (D,) of a descriptor.
    `sha256` is the card's fingerprint: weights, preparation and outputs (`card.sha256` is that of the file alone)."""

    def __init__(self, *, card: Card, output: str, shape: tuple[int, ...], sha256: str, session: Any) -> None:
        self.card, self.output, self.shape, self.sha256, self.session = card, output, shape, sha256, session

    def run(self, image: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
        """Run the network on uint8 (H, W[, 3]); returns float32 of `shape`. Pixels where bool (H, W) `mask` is False
        are filled with the mean of the others. Raises ModelError for a result with NaN or numbers beyond 1e12, and for
        one of zeros only."""
        return _run(self.card, self.output, self.session, without_masked(image, mask))


def open_backbone(model: str, output: str, threads: int = 1) -> Backbone:
    """Open the network of the card `model`, for its output "features" or "descriptor".

    Raises ModelError, one sentence, for any of: no onnxruntime, no card, no file or another one than the card's, no
    ONNX, inputs or outputs of another form, axes without a size, a result that is not finite or all zeros. Raises
    UsageError for a number of threads outside 1 to 256.
    """
    return backbone_of(load_card(model), output, threads)


def backbone_of(card: Card, output: str, threads: int = 1) -> Backbone:
    """Open the network of a card that is already loaded, as `open_backbone` does."""
    if getattr(card.outputs, output) is None:
        raise ModelError(
            f"{card.path} names no output for `{output}`: use another model, or name its ONNX output in "
            f"`outputs: {{{output}: ...}}`."
        )
    session = open_session(card, [getattr(card.outputs, output)], threads)
    # Noise, not a uniform picture: many a correct network gives only zeros for that.
    noise = np.random.default_rng(_SEED).integers(0, 256, (card.input.height, card.input.width), np.uint8)
    result = _run(card, output, session, noise)
    return Backbone(card=card, output=output, shape=result.shape, sha256=card.fingerprint, session=session)


def open_session(card: Card, outputs: list[str], threads: int = 1) -> Any:
    """Open the session of a card's file, and check its input and the outputs of these names; see `open_backbone` for
    what is raised."""
    if not 1 <= threads <= _MOST_THREADS:
        raise UsageError(f"{card.name} cannot run with threads={threads}: give 1 to {_MOST_THREADS}.")
    session = _session(card.file_path, card.sha256, threads)
    _require_input(card, session)
    for name in outputs:
        _require_output(card, name, session)
    return session


def file_sha256(path: Path) -> str:
    """Compute the SHA-256 of a model file, 64 hexadecimal digits. Raises ModelError if it cannot be read."""
    try:
        return sha256_of(path, MAX_FILE_BYTES)
    except OSError as error:
        raise ModelError(
            f"{path} cannot be read ({error.strerror}): put the weights there, or take the card away."
        ) from error


@cache
def _session(path: Path, sha256: str, threads: int) -> Any:
    """Open the session of a file: one in the process, however many techniques use it."""
    found = file_sha256(path)
    if found != sha256:
        raise ModelError(
            f"{path} is not the file of its card: its SHA-256 is {found} and the card says {sha256}; get the right "
            "file, or correct the card."
        )
    runtime = import_onnxruntime()
    options = runtime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    # The arena stays on: without it the memory of the same network varied from 20 to 60 MB, depending on malloc, and
    # was lower for few of six networks tried.
    options.log_severity_level = 4  # fatal messages only: edgevpr reports errors itself
    # Threads that wait for work by spinning draw power and do nothing.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    # Weights in a second file are refused, since the hash would not cover them. For a model given as bytes onnxruntime
    # would look for them in the working directory, so a folder is named that does not exist.
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", str(path))
    try:
        return runtime.InferenceSession(read_file(path, MAX_FILE_BYTES), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime's own classes, and RuntimeError
        raise ModelError(
            f"{path} cannot be opened as an ONNX model with its weights inside ({_first_line(error)}): export it again."
        ) from error


def import_onnxruntime() -> Any:
    """Import onnxruntime and return it. Raises ModelError if it cannot be imported."""
    # Else a thread of it reports its use to its maker, and keeps a file for that in the home folder (1.31 and 1.32).
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    try:
        import onnxruntime
    except Exception as error:  # a broken installation raises OSError, or an error of NumPy
        raise ModelError(
            f"onnxruntime cannot be imported ({_first_line(error)}): install it again (`pip install onnxruntime`) for "
            "the techniques with networks; hog, cohog and seqslam fly without it."
        ) from error
    return onnxruntime


def _require_input(card: Card, session: Any) -> None:
    rule, inputs = card.input, session.get_inputs()
    if len(inputs) != 1:
        raise ModelError(
            f"{card.file_path} has {len(inputs)} inputs: only networks with one, the picture, can be used."
        )
    (it,) = inputs
    channels = 1 if rule.colour == "grey" else 3
    size = (rule.height, rule.width)
    wanted = [1, *size, channels] if rule.layout == "NHWC" else [1, channels, *size]
    shape = list(it.shape)
    if any(type(axis) is not int for axis in shape[1:]):
        raise ModelError(
            f"{card.file_path}: its input {_axes(shape)} has axes without a size (only the first, the batch, may be "
            f"such): export it with the fixed size {_axes(wanted)}."
        )
    if shape[:1] and type(shape[0]) is not int:
        shape[0] = 1
    if shape != wanted or it.type != "tensor(float)":
        raise ModelError(
            f"{card.file_path}: its input is {it.type} {_axes(shape)} and the card says float {_axes(wanted)}: correct "
            "`input` of the card, or export the network for it."
        )


def _require_output(card: Card, name: str, session: Any) -> None:
    found = {each.name: each for each in session.get_outputs()}
    if name not in found:
        raise ModelError(f"{card.file_path} has no output `{name}`, which its card names: it has {', '.join(found)}.")
    if found[name].type not in ("tensor(float)", "tensor(float16)"):
        raise ModelError(f"{card.file_path}: its output `{name}` is {found[name].type}: it must be float.")


def _run(card: Card, output: str, session: Any, image: np.ndarray) -> np.ndarray:
    name = getattr(card.outputs, output)
    (result,) = run_outputs(card, session, [name], prepare(image, card.input))
    if result.ndim != _RANKS[output] or len(result) != 1 or not result.size:
        raise ModelError(
            f"{card.file_path}: its output `{name}` is {_axes(result.shape)} and `{output}` must be {_FORMS[output]}: "
            "correct `outputs` of the card."
        )
    values = result[0].astype(np.float32, copy=False)
    if not values.any():
        raise ModelError(
            f"{card.file_path} gives nothing but zeros for `{name}`: its weights or `input` of its card are wrong, or "
            "the picture shows nothing at all."
        )
    if output == "features" and card.input.layout == "NHWC":
        values = np.ascontiguousarray(values.transpose(2, 0, 1))
    return values


def run_outputs(card: Card, session: Any, names: list[str], pictures: np.ndarray) -> list[np.ndarray]:
    """Run a session of `open_session` on prepared pictures, float32 (N, ...); return the outputs named.

    Raises ModelError for a run that fails or takes too long, and for numbers that are not finite or beyond 1e12.
    """
    feed = {session.get_inputs()[0].name: pictures}
    options = import_onnxruntime().RunOptions()
    limit = threading.Timer(_RUN_LIMIT_S, _terminate, (options,))
    limit.daemon = True
    limit.start()
    try:
        results = session.run(names, feed, options)
    except Exception as error:
        if options.terminate:
            raise ModelError(
                f"{card.file_path} had no result for a picture within {_RUN_LIMIT_S:g} s: it loops, or is too slow for "
                "this board."
            ) from error
        raise ModelError(f"{card.file_path} cannot be run ({_first_line(error)}): export it again.") from error
    finally:
        limit.cancel()
    for name, result in zip(names, results, strict=True):
        # Written with `not`, so that NaN is refused as well.
        if result.size and not max(result.max(), -result.min()) <= _LARGEST:
            raise ModelError(
                f"{card.file_path} gives numbers that are not finite, or beyond {_LARGEST:g}, for `{name}`: its "
                "weights or `input` of its card are wrong."
            )
    return results


def _terminate(options: Any) -> None:
    options.terminate = True  # onnxruntime looks at it before each operator, in loops too


def _axes(shape) -> str:
    return f"({', '.join(str(axis) if type(axis) is int else '?' for axis in shape)})"


def _first_line(error: Exception) -> str:
    return (str(error).strip() or type(error).__name__).splitlines()[0][:200]
