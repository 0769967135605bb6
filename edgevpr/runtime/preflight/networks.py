"""Networks, as `edgevpr models` handles them: list them, try one, add one. A card is the YAML file that describes one.

`dataclasses.asdict` of every result can be written as JSON.
"""

import json
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from edgevpr import techniques
from edgevpr.core.arrays import Image
from edgevpr.core.child import ask_child, serve_parent
from edgevpr.core.config import build
from edgevpr.core.errors import EdgevprError, ModelError
from edgevpr.core.files import own_models, read_file, write_whole
from edgevpr.core.yamlfile import MAX_FILE_BYTES, read_yaml
from edgevpr.power.machine import rss_mb
from edgevpr.power.meter import stage
from edgevpr.runtime.recognise.gate_networks import CROPS, Detector, Memorability
from edgevpr.techniques.card import Card, card_names, load_card, read_card
from edgevpr.techniques.session import Backbone, file_sha256, import_onnxruntime

_ROUNDS = 10
_FRAME = (480, 640)
_LIMIT_S = 120.0  # of a trial: at this limit, each of its ten pictures takes twelve seconds


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
class Verified:
    """Figures of a network that works here. `shapes`: of each output, for one picture (of a detector: its mask; of
    memorability: its crops). `vector_length`: numbers in the descriptor of the technique of that name (None: the
    network is no technique). `image_ms`: time of the quickest of ten images of 640x480. `runtime_mb`: memory that
    importing onnxruntime took. `network_mb`: memory that the network took in addition."""

    name: str
    title: str
    threads: int
    file_mb: float
    shapes: dict[str, tuple[int, ...]]
    vector_length: int | None
    image_ms: float
    runtime_mb: float
    network_mb: float


def list_models() -> tuple[Listed, ...]:
    """List the networks of all cards, including those that cannot be read. No network is run."""
    return tuple(map(_read_listed, card_names()))


def verify(card: Card, threads: int = 1) -> Verified:
    """Check that the network of a card works, by `verify_here` in a child process, for at most two minutes.

    In a new process no other network has loaded libraries, whose memory would be missing from the figures. A network
    that is too large for the board, or never ends, ends the child process instead of this one. Raises EdgevprError if
    that happens, or if the network does not work.
    """
    job = {"card": asdict(card) | {"path": str(card.path)}, "threads": threads}
    answer = ask_child("edgevpr.runtime.preflight.networks", job, _LIMIT_S, f"Trying {card.file_path}")
    return Verified(**answer | {"shapes": {output: tuple(shape) for output, shape in answer["shapes"].items()}})


def verify_here(card: Card, threads: int = 1) -> Verified:
    """Load the network of a card, run it on ten random pictures, and return its figures. Raises ModelError for anything
    that would prevent its use in flight."""
    from edgevpr.techniques.network import of_card

    before_mb = rss_mb()
    import_onnxruntime()
    imported_mb = rss_mb()
    shapes: dict[str, tuple[int, ...]] = {}
    runs: list[Callable[[Image], object]] = []
    for output in ("descriptor", "features"):
        if getattr(card.outputs, output):
            backbone = Backbone(card, output, threads)
            shapes[output] = backbone.shape
            runs.append(backbone.run)
    if card.outputs.boxes:
        shapes["boxes"] = _FRAME
        runs.append(Detector(card, threads).is_static)
    if card.outputs.memorability:
        shapes["memorability"] = (CROPS, CROPS)
        runs.append(Memorability(card, threads).matrix)
    rng = np.random.default_rng(0)
    costs = []
    for _ in range(_ROUNDS):
        frame = rng.integers(0, 256, _FRAME, np.uint8)
        with stage() as running:
            runs[0](frame)
        costs.append(running.cost)
    return Verified(
        name=card.name,
        title=card.title,
        threads=threads,
        file_mb=card.file_path.stat().st_size / 1e6,
        shapes=shapes,
        vector_length=of_card(card).spec.coarse.shape[0] if card.is_technique else None,
        image_ms=1000 * min(cost.wall_s for cost in costs),
        runtime_mb=imported_mb - before_mb,
        network_mb=rss_mb() - imported_mb,
    )


def add(file: Path, card_path: Path, threads: int = 1) -> tuple[Verified, Path]:
    """Copy a network's file and card to the user's models folder, each completely or not at all, if the network works.
    The SHA-256 on the card must be that of the file; if the card has none, it is added. Returns the figures of the
    network and the path of the new card. Raises EdgevprError if the network does not work, or another has its name."""
    card = read_card(card_path, needs_hash=False)
    sha256 = file_sha256(file)
    if card.sha256 not in ("", sha256):
        raise ModelError(
            f"{file} is not the file of {card_path}: its SHA-256 is {sha256} and the card says {card.sha256}; get the "
            "right file, or correct the card."
        )
    target = own_models() / f"{card.name}.yaml"
    # Try the file where it is. The file name on the card is used only in the folder that both are copied to.
    verified = verify(
        replace(card, sha256=sha256, path=file.absolute().with_name(target.name), file=file.name), threads
    )
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
    return verified, target


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


def _verify_job(job: dict[str, Any]) -> dict[str, Any]:
    card = build(Card, {**job["card"], "path": Path(job["card"]["path"])}, job["card"]["path"])
    return asdict(verify_here(card, job["threads"]))


if __name__ == "__main__":
    serve_parent(_verify_job)
