"""Networks, as `edgevpr models list` shows and tries them. A card is the YAML file that describes one."""

from dataclasses import asdict, dataclass

import numpy as np

from edgevpr import techniques
from edgevpr.core.errors import EdgevprError
from edgevpr.runtime.recognise.gate_networks import Detector, Memorability
from edgevpr.techniques.card import Card, list_cards, load_card
from edgevpr.techniques.session import Backbone

_FRAME_SHAPE = (480, 640)


@dataclass(frozen=True, slots=True, kw_only=True)
class ModelEntry:
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


def list_models() -> tuple[ModelEntry, ...]:
    """List the networks of all cards, including those that cannot be used. Each is run once."""
    return tuple(map(_check_model, list_cards()))


def try_network(card: Card) -> None:
    """Load the network of a card, and run each of its outputs on a random picture. Raises ModelError for anything that
    would prevent its use in flight."""
    frame = np.random.default_rng(0).integers(0, 256, _FRAME_SHAPE, np.uint8)
    for output in ("descriptor", "features"):
        if getattr(card.outputs, output):
            Backbone(card, output).run(frame)
    if card.outputs.boxes:
        Detector(card).is_static(frame)
    if card.outputs.memorability:
        Memorability(card).compute_matrix(frame)


def _check_model(name: str) -> ModelEntry:
    try:
        card = load_card(name)
        try_network(card)
    except EdgevprError as error:
        return ModelEntry(name=name, problem=str(error))
    outputs = tuple(output for output, layer in asdict(card.outputs).items() if layer)
    users = [card.name] if card.is_technique and not techniques.is_builtin(card.name) else []
    for technique in techniques.list_techniques():
        is_of_card = techniques.read_parameters(technique).get("model") == card.name
        if is_of_card and techniques.find_network_output(technique) in outputs:
            users.append(technique)
    users += ["salience.detector"] if card.detector else []
    users += ["salience.network"] if card.outputs.memorability else []
    return ModelEntry(
        name=name,
        title=card.title,
        licence=card.licence,
        source=card.source,
        file=str(card.file_path),
        outputs=outputs,
        techniques=tuple(users),
    )
