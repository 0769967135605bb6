"""The card of a network: a YAML file that names the weights, the preparation of a picture, and the outputs.

Every error in a card is reported when the card is read, not in flight.
"""

import hashlib
import json
import re
from dataclasses import asdict, dataclass, field
from functools import cached_property
from pathlib import Path

from edgevpr.core.config import bounded, build
from edgevpr.core.contract import TechniqueSpec
from edgevpr.core.errors import ConfigError, ModelError
from edgevpr.core.files import find_model, model_folders
from edgevpr.core.text import meant
from edgevpr.core.yamlfile import read_yaml

SIMILARITIES = ("cosine", "l1", "l2")
_ADDED_LATER = ("pad", "boxes", "memorability")
FAMILIES = ("yolox", "fastestdet", "nanodet")  # of detectors
_CHOICES = {
    "input.layout": ("NCHW", "NHWC"),
    "input.colour": ("grey", "bgr", "rgb"),
    "input.resize": ("area", "linear", "cubic"),
    "similarity": SIMILARITIES,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class InputRule:
    """Preparation of a picture for the network: (pixel * `scale` - `mean`) / `std`. `mean` and `std` are one number, or
    one per channel. With `equalise` the histogram of the brightness is equalised first. `resize` is the interpolation
    by which the picture is stretched to the size; with `pad`, it keeps its shape in the upper left corner, and the rest
    has that grey level. With `layout` NHWC feature maps are (1, H, W, C) as well."""

    layout: str
    height: int = bounded(8, 4096)
    width: int = bounded(8, 4096)
    colour: str
    equalise: bool
    resize: str
    scale: float = bounded(1e-9, 1e9)
    mean: list
    std: list | None = None
    pad: int | None = field(default=None, metadata={"range": (0, 255)})


@dataclass(frozen=True, slots=True)
class Outputs:
    """Names in the ONNX file of a vector (1, D), of a feature map (1, C, H, W), of all that the family of a detector
    decodes its boxes from, and of the memorability of a picture (1, 1) in 0..1; None: the card names none."""

    descriptor: str | None = None
    features: str | None = None
    boxes: list | None = None
    memorability: str | None = None


@dataclass(frozen=True, slots=True)
class DetectorRule:
    """Reading of the outputs `boxes`: by the decoder of a `family` of detectors. `dynamic` are the classes of what does
    not stay where it is, each with its number in the outputs; a box counts from `min_score` on."""

    family: str
    dynamic: dict
    min_score: float = bounded(0.01, 1)


@dataclass(frozen=True, slots=True)
class NoParameters:
    """Parameters of the heads `flatten`, `max` and `rmac`: there are none."""


@dataclass(frozen=True, slots=True)
class GemParameters:
    p: float = bounded(0.1, 100)


@dataclass(frozen=True, slots=True)
class GridParameters:
    rows: int = bounded(1, 1024)
    columns: int = bounded(1, 1024)
    how: str


@dataclass(frozen=True, slots=True)
class PyramidParameters:
    levels: list


@dataclass(frozen=True, slots=True)
class ProjectionParameters:
    length: int = bounded(8, 65_536)
    seed: int = bounded(0, 2**31)


@dataclass(frozen=True, slots=True)
class VladParameters:
    words: int = bounded(1, 65_536)


HEADS = {
    "flatten": NoParameters,
    "max": NoParameters,
    "gem": GemParameters,
    "grid": GridParameters,
    "pyramid": PyramidParameters,
    "projection": ProjectionParameters,
    "vlad": VladParameters,
    "rmac": NoParameters,
}


@dataclass(frozen=True, kw_only=True)
class Card:
    """One network. `path` is that of the card itself; `head` is a name of `HEADS` with its parameters, or None."""

    path: Path
    title: str
    file: str
    sha256: str
    licence: str
    source: str
    input: InputRule
    outputs: Outputs
    head: dict | None
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
        """Tell whether the card makes a descriptor by itself, and does not only serve techniques that take a
        `model`."""
        return self.head is not None or self.outputs.descriptor is not None

    @cached_property
    def fingerprint(self) -> str:
        """SHA-256 of everything that a feature map or vector depends on: the weights, the preparation of the picture,
        and the names of the outputs."""
        said = json.dumps([self.sha256, _used(self.input), _used(self.outputs)], sort_keys=True)
        return hashlib.sha256(said.encode()).hexdigest()


def _used(part: InputRule | Outputs) -> dict:
    """Return what a card says there, without the keys that were added later and are not used: words and maps made
    before then have the fingerprint without them."""
    return {key: value for key, value in asdict(part).items() if value is not None or key not in _ADDED_LATER}


def card_names() -> tuple[str, ...]:
    """Return the names of all cards in the user's folder and the shipped one, also of cards that cannot be read."""
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
    """Return the weights that a technique uses, in the words of its card; None for a technique without a network."""
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
        said = getattr(getattr(card, section) if section else card, last)
        if said not in choices:
            raise ModelError(f"{path}: `{key}` is `{said}`: write {', '.join(choices[:-1])} or {choices[-1]}.")
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
    channels = 1 if card.input.colour == "grey" else 3
    for key in ("mean", "std"):
        numbers = getattr(card.input, key)
        if numbers is not None and not _are_numbers(numbers, (1, channels), positive=key == "std"):
            raise ModelError(
                f"{path}: `input.{key}` is {numbers!s:.80}: write one number or {channels}, one a channel"
                + (", all above 0." if key == "std" else ".")
            )
    head_parameters(card)
    return card


def _require_detector(card: Card) -> None:
    boxes, rule = card.outputs.boxes, card.detector
    if (boxes is None) != (rule is None):
        raise ModelError(f"{card.path}: a detector needs both `outputs.boxes` and the section `detector`: write both.")
    if rule is None:
        return
    if not boxes or not all(isinstance(name, str) for name in boxes):
        raise ModelError(f"{card.path}: `outputs.boxes` is {boxes!s:.80}: write the names of ONNX outputs.")
    if rule.family not in FAMILIES:
        raise ModelError(
            f"{card.path}: `detector.family` is `{rule.family}`: write {', '.join(FAMILIES[:-1])} or {FAMILIES[-1]}."
        )
    numbers = rule.dynamic.values()
    if not numbers or not all(type(number) is int and 0 <= number < 10_000 for number in numbers):
        raise ModelError(f"{card.path}: `detector.dynamic` needs names of classes with their numbers, {{car: 2}}.")


def head_parameters(card: Card) -> object | None:
    """Return the parameters of the card's head as the dataclass of `HEADS`; None for a card without a head. Raises
    ModelError for a head that does not exist, lacks a feature map or has wrong `levels` or `how`, ConfigError for other
    parameters."""
    if card.head is None:
        return None
    name = card.head.get("name")
    if not isinstance(name, str) or name not in HEADS:
        name = str(name)[:80]
        raise ModelError(
            f"{card.path}: there is no head `{name}`: " + meant(name, HEADS, f"use {', '.join(HEADS)}, or null.")
        )
    if card.outputs.features is None:
        raise ModelError(
            f"{card.path}: the head `{name}` needs a feature map: name it in `outputs: {{features: ...}}`."
        )
    said = {key: value for key, value in card.head.items() if key != "name"}
    parameters = build(HEADS[name], said, str(card.path), "head.")
    if name == "pyramid":
        levels = parameters.levels
        if not levels or not all(type(level) is int and 1 <= level <= 64 for level in levels):
            raise ModelError(
                f"{card.path}: `head.levels` is {levels!s:.80}: write whole numbers from 1 to 64, e.g. [1, 2, 3]."
            )
    if name == "grid" and parameters.how not in ("mean", "max"):
        raise ModelError(f"{card.path}: `head.how` is `{parameters.how}`: write mean or max.")
    return parameters


def _are_numbers(values: list, counts: tuple[int, int], positive: bool) -> bool:
    return len(values) in counts and all(
        type(value) in (int, float) and abs(value) < 1e9 and (value > 0 or not positive) for value in values
    )
