"""The card of a network: a YAML file that describes its weights, the preparation of a picture, and its outputs.
Techniques, training and the salience gate use it. Errors in a card are reported when it is read, not in flight."""

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

_KEYS_ADDED_LATER = ("pad", "boxes", "memorability")  # see `_drop_unused_keys`


@dataclass(frozen=True, slots=True, kw_only=True)
class InputRule:
    """Preparation of a picture for the network: (pixel * `scale` - `mean`) / `std` (None: 1). `mean` and `std` are one
    number, or one per channel. With `equalise`, the brightness histogram is equalised first. The picture is stretched
    to `height` x `width` with the interpolation `resize`. If `pad`, a grey level, is set, the picture keeps its aspect
    ratio in the upper left corner, and the rest is filled with that level. `layout`, NCHW, is the order of axes."""

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
    (1, D). `features`: a feature map (1, C, H, W). `boxes`: all outputs from which the boxes of a detector are decoded.
    `memorability`: the memorability of a picture, (1, 1) in 0..1."""

    descriptor: str | None = None
    features: str | None = None
    boxes: list[str] | None = None
    memorability: str | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class DetectorRule:
    """How the `boxes` of an object detector are decoded: with the decoder of its `family`. `dynamic` maps the classes
    of movable objects, such as cars, to their indices in the outputs. Boxes scoring below `min_score` are ignored."""

    family: str = key(choices=("yolox", "fastestdet"))
    dynamic: dict[str, int]
    min_score: float = bounded_key(0.01, 1)


@dataclass(frozen=True, kw_only=True)
class Card:
    """The description of one network, read from a YAML file. `path` is the YAML file; `file` and `sha256` are the name
    and hash of the ONNX file in the same folder. `similarity` is the measure used to compare its descriptors."""

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
        """True if the network outputs a descriptor. Other cards can only be the `model` of a technique."""
        return self.outputs.descriptor is not None

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of everything that a feature map or vector depends on: the weights, the preparation of the picture,
        and the names of the outputs."""
        return compute_digest([self.sha256, _drop_unused_keys(self.input), _drop_unused_keys(self.outputs)])


def compute_digest(values: list[Any]) -> str:
    """Compute the SHA-256 of JSON-serialisable values: 64 hexadecimal digits."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def _drop_unused_keys(part: InputRule | Outputs) -> dict[str, Any]:
    """Return a section as a dict, without unused keys that later versions added: the fingerprint stays the same."""
    return {key: value for key, value in asdict(part).items() if value is not None or key not in _KEYS_ADDED_LATER}


def list_cards() -> tuple[str, ...]:
    """Return the names of all cards in the user's folder and the shipped one, including cards that cannot be read."""
    return tuple(sorted({path.stem for folder in list_model_folders() for path in folder.glob("*.yaml")}))


def load_card(name: str) -> Card:
    """Load the card `name`. Raises ModelError if there is none, or if it is invalid."""
    if path := find_model(f"{name}.yaml"):
        try:
            return read_card(path)
        except ConfigError as error:  # the card is at fault, not the user's request
            raise ModelError(str(error)) from error
    names = ", ".join(list_cards()) or "none"
    hint = suggest(name, list_cards(), f"the cards in your models folder and the shipped one are: {names}.")
    raise ModelError(f"There is no model `{name}`: {hint}")


def describe_weights(spec: TechniqueSpec) -> str | None:
    """Return one line that describes the weights of a technique: name, title, licence and source of the network's card;
    None if the technique has no network."""
    if spec.model_sha256 is None:
        return None
    card = load_card(str(spec.parameters.get("model", spec.name)))
    return f"{card.name}: {card.title} ({card.licence}; {card.source})"


def read_card(path: Path) -> Card:
    """Read one card. Raises ConfigError or ModelError if it is invalid."""
    card = build(Card, {"path": path, **read_yaml(path)}, str(path))
    for problem in _find_problems(card):
        raise ModelError(f"{path}: {problem}")
    return card


def _find_problems(card: Card) -> Iterator[str]:
    """Yield a sentence with a remedy for each fault that the checks of types and ranges cannot find."""
    boxes, rule, channels = card.outputs.boxes, card.detector, 1 if card.input.colour == "grey" else 3
    per_channel = f"but must be one number or {channels}, one per channel"
    if not re.fullmatch("[0-9a-f]{64}", card.sha256):
        yield f"`sha256` must be the 64 hexadecimal digits that `sha256sum {card.file}` prints."
    if card.input.layout != "NCHW":
        yield f"`input.layout` is `{card.input.layout:.20}`, but must be NCHW: export the network with that axis order."
    if card.file in ("", ".", "..") or "/" in card.file:
        yield f"`file` is `{card.file}`, but must be the name of a file in the same folder as the card."
    if card.file.lower().endswith((".yaml", ".yml")):
        yield f"`file` is `{card.file}`, which is the name of a card, but must be that of the ONNX file."
    if not any(asdict(card.outputs).values()):
        yield "`outputs` must name an ONNX output as `descriptor`, `features`, `boxes` or `memorability`."
    if (boxes is None) != (rule is None):
        yield "a detector needs both `outputs.boxes` and the section `detector`: add the missing one."
    if boxes is not None and not (boxes and all(isinstance(name, str) for name in boxes)):
        yield f"`outputs.boxes` is {boxes!s:.80}, but must be a list of names of ONNX outputs."
    indices = [0] if rule is None else list(rule.dynamic.values())
    if not indices or not all(type(index) is int and 0 <= index < 10_000 for index in indices):
        yield "`detector.dynamic` must map class names to class indices, such as {car: 2}."
    if not _are_per_channel(card.input.mean, channels, -1e9):
        yield f"`input.mean` is {card.input.mean!s:.80}, {per_channel}."
    if card.input.std is not None and not _are_per_channel(card.input.std, channels, 0):
        yield f"`input.std` is {card.input.std!s:.80}, {per_channel}, all above 0."


def _are_per_channel(values: list[float], channels: int, low: float) -> bool:
    """Return True if `values` has one number or one per channel, all above `low` and below 1e9."""
    return len(values) in (1, channels) and all(type(value) in (int, float) and low < value < 1e9 for value in values)
