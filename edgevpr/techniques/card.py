"""The card of a network: a YAML file that names the weights, the preparation of a picture, and the outputs. Techniques,
training and the commands for models use it. Every error in a card is reported when the card is read, not in flight."""

import hashlib
import json
import re
from dataclasses import asdict, dataclass, field, make_dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from edgevpr.core.config import bounded, build
from edgevpr.core.contract import TechniqueSpec
from edgevpr.core.errors import ConfigError, ModelError
from edgevpr.core.files import find_model, model_folders
from edgevpr.core.text import meant
from edgevpr.core.yamlfile import read_yaml

_ADDED_LATER = ("pad", "boxes", "memorability")  # keys, see _used
_CHOICES = {
    "input.layout": ("NCHW", "NHWC"),
    "input.colour": ("grey", "bgr", "rgb"),
    "input.resize": ("area", "linear", "cubic"),
    "similarity": ("cosine", "l1", "l2"),
    "detector.family": ("yolox", "fastestdet", "nanodet"),
}
# The parameters of each head: name, type and, for numbers, the range.
_HEADS: dict[str, tuple[tuple[Any, ...], ...]] = {
    "flatten": (),
    "max": (),
    "gem": (("p", float, bounded(0.1, 100)),),
    "grid": (("rows", int, bounded(1, 1024)), ("columns", int, bounded(1, 1024)), ("how", str)),
    "pyramid": (("levels", list),),
    "projection": (("length", int, bounded(8, 65_536)), ("seed", int, bounded(0, 2**31))),
    "vlad": (("words", int, bounded(1, 65_536)),),
    "rmac": (),
}


@dataclass(frozen=True, slots=True, kw_only=True)
class InputRule:
    """Preparation of a picture for the network: (pixel * `scale` - `mean`) / `std` (None: 1). `mean` and `std` are one
    number, or one per channel. With `equalise` the histogram of the brightness is equalised first. `resize` is the
    interpolation by which the picture is stretched to `height` x `width`. With `pad`, a grey level, it keeps its shape
    in the upper left corner, and the rest has that level. With `layout` NHWC feature maps are (1, H, W, C) too."""

    layout: str
    height: int = bounded(8, 4096)
    width: int = bounded(8, 4096)
    colour: str
    equalise: bool
    resize: str
    scale: float = bounded(1e-9, 1e9)
    mean: list[float]
    std: list[float] | None = None
    pad: int | None = field(default=None, metadata={"range": (0, 255)})

    @property
    def channels(self) -> int:
        return 1 if self.colour == "grey" else 3


@dataclass(frozen=True, slots=True)
class Outputs:
    """Names of the network's outputs in the ONNX file (None: the card names none): a vector (1, D), a feature map (1,
    C, H, W), all that the boxes of a detector are decoded from, and the memorability of a picture (1, 1) in 0..1."""

    descriptor: str | None = None
    features: str | None = None
    boxes: list[str] | None = None
    memorability: str | None = None


@dataclass(frozen=True, slots=True)
class DetectorRule:
    """Decoding of the outputs `boxes` of an object detector, by the decoder of its `family`. `dynamic` are the classes
    of movable things, such as cars, each with its number in the outputs. A box counts from the score `min_score` on."""

    family: str
    dynamic: dict[str, int]
    min_score: float = bounded(0.01, 1)


@dataclass(frozen=True, kw_only=True)
class Card:
    """One network. `path` is that of the card itself, `file` and `sha256` are the name and hash of the ONNX file beside
    it. `head` has the name of a head (see `network`) and its parameters (None: no head)."""

    path: Path
    title: str
    file: str
    sha256: str
    licence: str
    source: str
    input: InputRule
    outputs: Outputs
    head: dict[str, Any] | None
    similarity: str = "cosine"
    detector: DetectorRule | None = None

    @property
    def name(self) -> str:
        return self.path.stem

    @property
    def file_path(self) -> Path:
        return self.path.with_name(self.file)

    @property
    def is_technique(self) -> bool:
        """True if the card makes a descriptor by itself. Other cards only serve techniques that take a `model`."""
        return self.head is not None or self.outputs.descriptor is not None

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of everything that a feature map or vector depends on: the weights, the preparation of the picture,
        and the names of the outputs."""
        return digest_of([self.sha256, _used(self.input), _used(self.outputs)])


def digest_of(values: list[Any]) -> str:
    """Compute the SHA-256 of values that can be written as JSON: 64 hexadecimal digits."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def _used(part: InputRule | Outputs) -> dict[str, Any]:
    """Return a section of a card as a dict, without keys that were added to cards later and are not used here: words
    and maps made before then keep their fingerprint."""
    return {key: value for key, value in asdict(part).items() if value is not None or key not in _ADDED_LATER}


def card_names() -> tuple[str, ...]:
    """Return the names of all cards in the user's folder and the shipped one, including cards that cannot be read."""
    return tuple(sorted({path.stem for folder in model_folders() for path in folder.glob("*.yaml")}))


def load_card(name: str) -> Card:
    """Load the card called `name`. Raises ModelError if there is none, or if it is not valid."""
    if path := find_model(f"{name}.yaml"):
        try:
            return read_card(path)
        except ConfigError as error:  # one network cannot be used; the user's request is not wrong
            raise ModelError(str(error)) from error
    known = ", ".join(card_names()) or "there are none yet"
    raise ModelError(
        f"There is no model `{name}`: " + meant(name, card_names(), f"use one of `edgevpr models list` ({known}).")
    )


def weights_of(spec: TechniqueSpec) -> str | None:
    """Return a line on the weights of a technique: name, title, licence and source of the card (None: no network)."""
    if spec.model_sha256 is None:
        return None
    card = load_card(str(spec.parameters.get("model", spec.name)))
    return f"{card.name}: {card.title} ({card.licence}; {card.source})"


def read_card(path: Path, needs_hash: bool = True) -> Card:
    """Read one card. With `needs_hash` False, `sha256` may be missing or empty, for a card that is not filled in yet.
    Raises ConfigError or ModelError for a card that is not valid."""
    values = read_yaml(path)
    if not needs_hash:
        values = {**values, "sha256": values.get("sha256") or ""}
    card = build(Card, {"path": path, "head": None, **values}, str(path))
    for key, choices in _CHOICES.items():
        section, _, last = key.rpartition(".")
        part = getattr(card, section) if section else card
        if part is not None and getattr(part, last) not in choices:
            choice = f"write {', '.join(choices[:-1])} or {choices[-1]}."
            raise ModelError(f"{path}: `{key}` is `{getattr(part, last)}`: {choice}")
    if not re.fullmatch("[0-9a-f]{64}" if needs_hash else "([0-9a-f]{64})?", card.sha256):
        raise ModelError(f"{path}: `sha256` must be the 64 hexadecimal digits that `sha256sum {card.file}` prints.")
    if card.file in ("", ".", "..") or "/" in card.file:
        raise ModelError(f"{path}: `file` is `{card.file}`: write the name of a file that lies beside the card.")
    if card.file.lower().endswith((".yaml", ".yml")):
        raise ModelError(f"{path}: `file` is `{card.file}`, which is the name of a card: write that of the ONNX file.")
    if not any(asdict(card.outputs).values()):
        raise ModelError(
            f"{path}: `outputs` names none: write the ONNX output of a descriptor, of features, of boxes or of "
            "memorability."
        )
    _require_detector(card)
    _require_numbers(card, "mean", card.input.mean)
    _require_numbers(card, "std", card.input.std)
    head_parameters(card)
    return card


def _require_detector(card: Card) -> None:
    boxes, rule = card.outputs.boxes, card.detector
    if (boxes is None) != (rule is None):
        raise ModelError(f"{card.path}: a detector needs both `outputs.boxes` and the section `detector`: write both.")
    if boxes is None or rule is None:
        return
    if not boxes or not all(isinstance(name, str) for name in boxes):
        raise ModelError(f"{card.path}: `outputs.boxes` is {boxes!s:.80}: write the names of ONNX outputs.")
    if not rule.dynamic or not all(type(number) is int and 0 <= number < 10_000 for number in rule.dynamic.values()):
        raise ModelError(f"{card.path}: `detector.dynamic` needs names of classes with their numbers, {{car: 2}}.")


def _require_numbers(card: Card, key: str, values: list[float] | None) -> None:
    """Require that `values` are None, one number, or one per channel. Those of the key `std` are divisors: above 0."""
    channels, positive = card.input.channels, key == "std"
    if values is None or (
        len(values) in (1, channels)
        and all(type(each) in (int, float) and abs(each) < 1e9 and (each > 0 or not positive) for each in values)
    ):
        return
    also = ", all above 0." if positive else "."
    raise ModelError(
        f"{card.path}: `input.{key}` is {values!s:.80}: write one number or {channels}, one a channel{also}"
    )


def head_parameters(card: Card) -> dict[str, Any]:
    """Return the parameters of the card's head by name (empty: the card has no head). Raises ModelError for a head that
    does not exist, lacks a feature map or has wrong `levels` or `how`, ConfigError for other parameters."""
    if card.head is None:
        return {}
    name = card.head.get("name")
    if not isinstance(name, str) or name not in _HEADS:
        name = str(name)[:80]
        raise ModelError(
            f"{card.path}: there is no head `{name}`: " + meant(name, _HEADS, f"use {', '.join(_HEADS)}, or null.")
        )
    if card.outputs.features is None:
        raise ModelError(
            f"{card.path}: the head `{name}` needs a feature map: name it in `outputs: {{features: ...}}`."
        )
    written = {key: value for key, value in card.head.items() if key != "name"}
    parameters: dict[str, Any] = asdict(build(make_dataclass(name, _HEADS[name]), written, str(card.path), "head."))
    levels = parameters.get("levels", [1])
    if not levels or not all(type(level) is int and 1 <= level <= 64 for level in levels):
        raise ModelError(
            f"{card.path}: `head.levels` is {levels!s:.80}: write whole numbers from 1 to 64, e.g. [1, 2, 3]."
        )
    if parameters.get("how", "mean") not in ("mean", "max"):
        raise ModelError(f"{card.path}: `head.how` is `{parameters['how']}`: write mean or max.")
    return parameters
