"""The card of a network: a YAML file that names the weights, the preparation of a picture, and the outputs. Techniques,
training and the salience gate use it. Every error in a card is reported when the card is read, not in flight."""

import hashlib
import json
import re
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from edgevpr.core.config import bounded_key, build, key
from edgevpr.core.contract import TechniqueSpec
from edgevpr.core.errors import ConfigError, ModelError
from edgevpr.core.files import find_model, list_model_folders
from edgevpr.core.text import suggest
from edgevpr.core.yamlfile import read_yaml

_LATER_KEYS = ("pad", "boxes", "memorability")  # see `_drop_unknown_keys`


@dataclass(frozen=True, slots=True, kw_only=True)
class InputRule:
    """Preparation of a picture for the network: (pixel * `scale` - `mean`) / `std` (None: 1). `mean` and `std` are one
    number, or one per channel. With `equalise` the histogram of the brightness is equalised first. The picture is
    stretched to `height` x `width` by the interpolation `resize`; with `pad`, a grey level, it keeps its proportions in
    the upper left corner, and the rest has that level. `layout`, NCHW, is the order of axes."""

    layout: str
    height: int = bounded_key(8, 4096)
    width: int = bounded_key(8, 4096)
    colour: str = key(choices=("grey", "bgr", "rgb"))
    equalise: bool
    resize: str = key(choices=("area", "linear", "cubic"))
    scale: float = bounded_key(1e-9, 1e9)
    mean: list[float]
    std: list[float] | None = None
    pad: int | None = bounded_key(0, 255, default=None)


@dataclass(frozen=True, slots=True)
class Outputs:
    """Names of the network's outputs in the ONNX file (None: the network has no such output). `descriptor`: a vector
    (1, D). `features`: a feature map (1, C, H, W). `boxes`: all outputs that the boxes of a detector are decoded from.
    `memorability`: the memorability of a picture, (1, 1) in 0..1."""

    descriptor: str | None = None
    features: str | None = None
    boxes: list[str] | None = None
    memorability: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectorRule:
    """Decoding of the outputs `boxes` of an object detector, by the decoder of its `family`. `dynamic` are the classes
    of movable things, such as cars, each with its number in the outputs. A box counts from the score `min_score` on."""

    family: str = key(choices=("yolox", "fastestdet"))
    dynamic: dict[str, int]
    min_score: float = bounded_key(0.01, 1)


@dataclass(frozen=True, kw_only=True)
class Card:
    """The description of one network, read from a YAML file. `path` is that of the YAML file, `file` and `sha256` are
    the name and hash of the ONNX file beside it. `similarity` is the measure by which its descriptors are compared."""

    path: Path
    title: str
    file: str
    sha256: str
    licence: str
    source: str
    input: InputRule
    outputs: Outputs
    similarity: str = key("cosine", choices=("cosine", "l1"))
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
        return self.outputs.descriptor is not None

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of everything that a feature map or vector depends on: the weights, the preparation of the picture,
        and the names of the outputs."""
        return compute_digest([self.sha256, _drop_unknown_keys(self.input), _drop_unknown_keys(self.outputs)])


def compute_digest(values: list[Any]) -> str:
    """Compute the SHA-256 of values that can be written as JSON: 64 hexadecimal digits."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def _drop_unknown_keys(part: InputRule | Outputs) -> dict[str, Any]:
    """Return a section of a card as a dict, without the keys added in later versions that the card does not use, so
    that its fingerprint stays the same in all versions."""
    return {key: value for key, value in asdict(part).items() if value is not None or key not in _LATER_KEYS}


def list_cards() -> tuple[str, ...]:
    """Return the names of all cards in the user's folder and the shipped one, including cards that cannot be read."""
    return tuple(sorted({path.stem for folder in list_model_folders() for path in folder.glob("*.yaml")}))


def load_card(name: str) -> Card:
    """Load the card called `name`. Raises ModelError if there is none, or if it is not valid."""
    if path := find_model(f"{name}.yaml"):
        try:
            return read_card(path)
        except ConfigError as error:  # one network cannot be used; the user's request is not wrong
            raise ModelError(str(error)) from error
    names = ", ".join(list_cards()) or "there are none yet"
    hint = suggest(name, list_cards(), f"those of your models folder and the shipped ones are: {names}.")
    raise ModelError(f"There is no model `{name}`: {hint}")


def describe_weights(spec: TechniqueSpec) -> str | None:
    """Return one line on the weights that a technique uses: name, title, licence and source of the network's card; None
    if it has no network."""
    if spec.model_sha256 is None:
        return None
    card = load_card(str(spec.parameters.get("model", spec.name)))
    return f"{card.name}: {card.title} ({card.licence}; {card.source})"


def read_card(path: Path) -> Card:
    """Read one card. Raises ConfigError or ModelError for a card that is not valid."""
    card = build(Card, {"path": path, **read_yaml(path)}, str(path))
    for problem in _find_problems(card):
        raise ModelError(f"{path}: {problem}")
    return card


def _find_problems(card: Card) -> Iterator[str]:
    """Yield a sentence for each fault of a card that the checks of types and ranges cannot find, with its remedy."""
    boxes, rule, channels = card.outputs.boxes, card.detector, 1 if card.input.colour == "grey" else 3
    per_channel = f"write one number or {channels}, one a channel"
    if not re.fullmatch("[0-9a-f]{64}", card.sha256):
        yield f"`sha256` must be the 64 hexadecimal digits that `sha256sum {card.file}` prints."
    if card.input.layout != "NCHW":
        yield f"`input.layout` is `{card.input.layout:.20}`: export the network again with the axes in the order NCHW."
    if card.file in ("", ".", "..") or "/" in card.file:
        yield f"`file` is `{card.file}`: write the name of a file that lies beside the card."
    if card.file.lower().endswith((".yaml", ".yml")):
        yield f"`file` is `{card.file}`, which is the name of a card: write that of the ONNX file."
    if not any(asdict(card.outputs).values()):
        yield "`outputs` is empty: write the ONNX output of a descriptor, of features, of boxes or of memorability."
    if (boxes is None) != (rule is None):
        yield "a detector needs both `outputs.boxes` and the section `detector`: write both."
    if boxes is not None and not (boxes and all(isinstance(name, str) for name in boxes)):
        yield f"`outputs.boxes` is {boxes!s:.80}: write the names of ONNX outputs."
    numbers = [0] if rule is None else list(rule.dynamic.values())
    if not numbers or not all(type(number) is int and 0 <= number < 10_000 for number in numbers):
        yield "`detector.dynamic` needs names of classes with their numbers, {car: 2}."
    if not _are_per_channel(card.input.mean, channels, -1e9):
        yield f"`input.mean` is {card.input.mean!s:.80}: {per_channel}."
    if card.input.std is not None and not _are_per_channel(card.input.std, channels, 0):
        yield f"`input.std` is {card.input.std!s:.80}: {per_channel}, all above 0."


def _are_per_channel(values: list[float], channels: int, above: float) -> bool:
    """Tell whether `values` are one number or one per channel, all larger than `above` and less than 1e9."""
    return len(values) in (1, channels) and all(type(value) in (int, float) and above < value < 1e9 for value in values)
