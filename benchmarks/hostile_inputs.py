"""Hostile inputs: generated images, EXIF data, tables, configurations, cards, networks and paths, each given to a real
command in a process of its own, with limits of time and memory.

A command may refuse an input, with one sentence and exit code 1 or 2, or use it. Counted is what it may not do: end
with a traceback, not end, end with another code, a signal or without a sentence, or print a control character or a
password.
"""

import os
import random
import resource
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import hostile_files as files
from base import Row

LIMIT_S = 60.0  # far more than any of these commands takes on its own
MEMORY_BYTES = 4 << 30  # of addresses, of which the libraries alone take a good part
_AT_ONCE = 8  # images in one folder, for one command
_SAID = b"edgevpr: "


@dataclass(frozen=True, slots=True, kw_only=True)
class Attempt:
    """One command over `inputs` hostile inputs, and the exit codes that it may have."""

    argv: Sequence[str | bytes]
    codes: frozenset[int]
    inputs: int = 1


def run(count: int, seed: int) -> list[Row]:
    """Try `count` inputs of each kind; the same seed makes the same inputs. `examples` of a row say what went wrong, at
    most three times."""
    with tempfile.TemporaryDirectory() as folder:
        ground = _Ground.made(Path(folder))
        return [_tried(kind, make, ground, count, random.Random(f"{seed} {kind}")) for kind, make in KINDS.items()]


@dataclass(frozen=True, slots=True, kw_only=True)
class _Ground:
    """Harmless files that hostile ones are put beside: two pictures, a map of them, a network and its card."""

    folder: Path
    pictures: Path
    map: Path
    network: Path
    card: str

    @classmethod
    def made(cls, folder: Path) -> "_Ground":
        pictures = folder / "pictures"
        pictures.mkdir()
        for number in range(2):
            (pictures / f"{number}.jpg").write_bytes(files.picture(".jpg", number))
        place_map = folder / "m.gpkg"
        subprocess.run([sys.executable, "-m", "edgevpr", *_built(folder, pictures)], check=True, capture_output=True)
        models = Path(__file__).parents[1] / "models"
        lines = (models / "calc.yaml").read_text("utf-8").splitlines(keepends=True)
        card = "".join(line for line in lines if not line.startswith("sha256"))
        return cls(folder=folder, pictures=pictures, map=place_map, network=models / "calc.onnx", card=card)


def _images(ground: _Ground, here: Path, chance: random.Random, left: int) -> Attempt:
    inputs = min(left, _AT_ONCE)
    for number in range(inputs):
        files.write_image(here, number, chance)
    (here / "whole.jpg").write_bytes(files.picture(".jpg", 1))
    return Attempt(argv=["match", str(ground.map), "--images", str(here)], codes=frozenset((0, 1)), inputs=inputs)


def _built(here: Path, pictures: Path) -> list[str]:
    # Without a technique to insist on, each would first be tried in a process of its own.
    return ["map", "build", str(here / "m.gpkg"), "--images", str(pictures), "--technique", "cohog"]


def _exif(ground: _Ground, here: Path, chance: random.Random, left: int) -> Attempt:
    inputs = min(left, _AT_ONCE)
    for number in range(inputs):
        (here / f"{number}.jpg").write_bytes(files.with_exif(files.picture(".jpg", 1), chance))
    return Attempt(argv=_built(here, here), codes=frozenset((0,)), inputs=inputs)


def _positions(ground: _Ground, here: Path, chance: random.Random, left: int) -> Attempt:
    path = files.write_table(here / "p.csv", files.POSITIONS, chance)
    return Attempt(argv=[*_built(here, ground.pictures), "--positions", str(path)], codes=frozenset((0, 2)))


def _truth(ground: _Ground, here: Path, chance: random.Random, left: int) -> Attempt:
    path = files.write_table(here / "t.csv", files.TRUTH, chance)
    data = ["--query", str(ground.pictures), "--ref", str(ground.pictures), "--ground-truth", str(path)]
    return Attempt(argv=["eval", *data, "--techniques", "seqslam"], codes=frozenset((0, 2)))


def _configuration(ground: _Ground, here: Path, chance: random.Random, left: int) -> Attempt:
    path = files.write_yaml(here / "c.yaml", files.CONFIGURATION, chance)
    # A configuration that is right by chance flies over two pictures, and ends.
    source = ["--source", str(ground.pictures), "--map", str(ground.map), "--log", str(here / "log")]
    return Attempt(argv=["run", "--config", str(path), *source], codes=frozenset((0, 1, 2)))


def _cards(ground: _Ground, here: Path, chance: random.Random, left: int) -> Attempt:
    card = files.write_yaml(here / "net.yaml", ground.card, chance)
    return Attempt(argv=["models", "add", str(ground.network), "--card", str(card)], codes=frozenset((0, 1, 2)))


def _networks(ground: _Ground, here: Path, chance: random.Random, left: int) -> Attempt:
    (here / "net.yaml").write_text(ground.card, "utf-8")
    network = files.write_network(here / "net.onnx", ground.network.read_bytes(), chance)
    return Attempt(argv=["models", "add", str(network), "--card", str(here / "net.yaml")], codes=frozenset((0, 1)))


def _paths(ground: _Ground, here: Path, chance: random.Random, left: int) -> Attempt:
    path = files.odd_path(here, chance)
    pictures, place_map = str(ground.pictures), str(ground.map)
    data = ["eval", "--techniques", "hog", "--query", pictures, "--ref"]
    argv: Sequence[str | bytes] = chance.choice(
        (
            ["match", place_map, "--images", path],
            ["match", place_map, "--images", pictures, "--positions", path],
            ["match", place_map, "--images", pictures, "--board", path],
            ["run", "--config", path],
            ["check", "--config", path],
            ["service", "--config", path],
            ["models", "add", path, "--card", str(here / "none.yaml")],
            ["models", "add", str(ground.network), "--card", path],
            [*data, path, "--ground-truth", "t.csv"],
            [*data, pictures, "--ground-truth", path],
        )
    )
    may_work = argv[0] == "service" or path in ("", b"")  # no board, no positions
    return Attempt(argv=argv, codes=frozenset((0, 1, 2) if may_work else (1, 2)))


Maker = Callable[[_Ground, Path, random.Random, int], Attempt]
KINDS: dict[str, Maker] = {
    "images": _images,
    "EXIF": _exif,
    "positions.csv": _positions,
    "ground truth": _truth,
    "configurations": _configuration,
    "cards": _cards,
    "networks": _networks,
    "paths": _paths,
}


def _tried(kind: str, make: Maker, ground: _Ground, count: int, chance: random.Random) -> Row:
    tried, wrongs, examples = 0, {"traceback": 0, "hang": 0, "exit code": 0, "leak": 0}, []
    while tried < count:
        here = Path(tempfile.mkdtemp(dir=ground.folder))
        attempt = make(ground, here, chance, count - tried)
        tried += attempt.inputs
        for wrong, said in _wrongs(attempt, here):
            wrongs[wrong] += 1
            if len(examples) < 3:
                shown = " ".join(os.fsdecode(word) for word in attempt.argv)
                examples.append(f"{wrong}: edgevpr {shown!a:.300}: ... {said[-900:]!a}")
        shutil.rmtree(here)
    counts = dict(zip(("tracebacks", "hangs", "wrong_exit_codes", "leaks"), wrongs.values(), strict=True))
    return {"kind": kind, "tried": tried, **counts, "examples": examples}


def _wrongs(attempt: Attempt, here: Path) -> Iterator[tuple[str, str]]:
    """Run the command, and yield what it did wrong, with what it said."""
    try:
        done = subprocess.run(
            [sys.executable, "-m", "edgevpr", *attempt.argv],
            capture_output=True,
            stdin=subprocess.DEVNULL,
            timeout=LIMIT_S,
            env={**os.environ, "EDGEVPR_MODELS": str(here / "models"), "XDG_DATA_HOME": str(here / "data")},
            preexec_fn=_limited,
        )
    except subprocess.TimeoutExpired as late:
        yield "hang", os.fsdecode((late.stderr or b"")[-500:])
        return
    said = os.fsdecode(done.stderr[-2000:])
    if b"Traceback (most" in done.stderr:
        yield "traceback", said
    is_said = _SAID in done.stderr or b"usage: " in done.stderr or attempt.argv[0] == "check"
    if done.returncode not in attempt.codes or (done.returncode and not is_said):
        yield "exit code", f"{done.returncode} {said}"
    if b"\x1b" in done.stdout + done.stderr or b"secret" in done.stdout + done.stderr:
        yield "leak", said


def _limited() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
