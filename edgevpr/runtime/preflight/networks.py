"""Networks, as `edgevpr models` handles them: list them, try and add one. A card is the YAML file that describes one.

`dataclasses.asdict` of every result can be written as JSON.
"""

import json
import shutil
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr import techniques
from edgevpr.core.errors import EdgevprError, ModelError
from edgevpr.core.files import own_models, read_file, write_whole
from edgevpr.core.yamlfile import MAX_FILE_BYTES, read_yaml
from edgevpr.runtime.recognise.gate_networks import CROPS, Detector, Memorability
from edgevpr.techniques.card import Card, card_names, load_card, read_card
from edgevpr.techniques.session import Backbone, file_sha256

_FRAME = (480, 640)


@dataclass(frozen=True, slots=True, kw_only=True)
class Listed:
    """One line of the list of networks: the card called `name`. `problem`: why the card or its network file cannot be
    used, in a sentence (None: both can); if it is set, all other fields except `name` are empty. `file`: path of the
    network file. `outputs`: kinds of output that the network has. `techniques`: the techniques and settings that use
    the network by default."""

    name: str
    problem: str | None = None
    title: str | None = None
    licence: str | None = None
    source: str | None = None
    file: str | None = None
    outputs: tuple[str, ...] = ()
    techniques: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Added:
    """A network that works here and was added. `card`: path of its card. `shapes`: of each output, for one picture (of
    a detector: its mask; of memorability: its crops). `vector_length`: numbers in the descriptor of the technique of
    that name (None: the network is no technique)."""

    card: str
    name: str
    title: str
    shapes: dict[str, tuple[int, ...]]
    vector_length: int | None


def list_models() -> tuple[Listed, ...]:
    """List the networks of all cards, including those that cannot be read. No network is run."""
    return tuple(map(_read_listed, card_names()))


def run_network(card: Card) -> dict[str, tuple[int, ...]]:
    """Load the network of a card, run each of its outputs on a random picture, and return their shapes. Raises
    ModelError for anything that would prevent its use in flight."""
    frame = np.random.default_rng(0).integers(0, 256, _FRAME, np.uint8)
    shapes: dict[str, tuple[int, ...]] = {}
    for output in ("descriptor", "features"):
        if getattr(card.outputs, output):
            backbone = Backbone(card, output)
            backbone.run(frame)
            shapes[output] = backbone.shape
    if card.outputs.boxes:
        Detector(card).is_static(frame)
        shapes["boxes"] = _FRAME
    if card.outputs.memorability:
        Memorability(card).matrix(frame)
        shapes["memorability"] = (CROPS, CROPS)
    return shapes


def add(file: Path, card_path: Path) -> Added:
    """Copy a network's file and card to the user's models folder, each completely or not at all, if the network works.
    The SHA-256 on the card must be that of the file; if the card has none, it is added. Raises EdgevprError if the
    network does not work, or another has its name."""
    from edgevpr.techniques.network import of_card

    card = read_card(card_path, needs_hash=False)
    sha256 = file_sha256(file)
    if card.sha256 not in ("", sha256):
        raise ModelError(
            f"{file} is not the file of {card_path}: its SHA-256 is {sha256} and the card says {card.sha256}; get the "
            "right file, or correct the card."
        )
    target = own_models() / f"{card.name}.yaml"
    # Try the file where it is. The file name on the card is used only in the folder that both are copied to.
    tried = replace(card, sha256=sha256, path=file.absolute().with_name(target.name), file=file.name)
    shapes = run_network(tried)
    vector_length = of_card(tried).spec.coarse.shape[0] if card.is_technique else None
    text = _read_text(card_path) if card.sha256 else card_text({**read_yaml(card_path), "sha256": sha256})
    network = target.with_name(card.file)
    card_differs = target.exists() and _read_text(target) != text
    if card_differs or (network.exists() and file_sha256(network) != sha256):
        raise ModelError(
            f"{target if card_differs else network} is there already and is of another network: take it away, or name "
            "yours otherwise."
        )
    network.parent.mkdir(parents=True, exist_ok=True)
    if not network.exists():
        write_whole(network, lambda unfinished: shutil.copyfile(file, unfinished))
    write_whole(target, lambda unfinished: unfinished.write_text(text, "utf-8"))
    return Added(
        card=str(target),
        name=card.name,
        title=card.title,
        shapes=shapes,
        vector_length=vector_length,
    )


def card_text(values: dict[str, Any]) -> str:
    """Return a card as YAML text, one line per key. JSON values are valid YAML."""
    return "".join(f"{key}: {json.dumps(value, ensure_ascii=False)}\n" for key, value in values.items())


def _read_text(card_path: Path) -> str:
    return read_file(card_path, MAX_FILE_BYTES).decode("utf-8")


def _read_listed(name: str) -> Listed:
    try:
        card = load_card(name)
        sha256 = file_sha256(card.file_path)
        if sha256 != card.sha256:
            raise ModelError(f"{card.file_path} is not the file of its card: its SHA-256 is {sha256}.")
    except EdgevprError as error:
        return Listed(name=name, problem=str(error))
    outputs = tuple(output for output, layer in asdict(card.outputs).items() if layer)
    users = [card.name] if card.is_technique and not techniques.is_own(card.name) else []
    for technique in techniques.names():
        is_of_card = techniques.parameters(technique).get("model") == card.name
        if is_of_card and techniques.network_output(technique) in outputs:
            users.append(technique)
    users += ["salience.detector"] if card.detector else []
    users += ["salience.network"] if card.outputs.memorability else []
    return Listed(
        name=name,
        title=card.title,
        licence=card.licence,
        source=card.source,
        file=str(card.file_path),
        outputs=outputs,
        techniques=tuple(users),
    )
