"""Hostile inputs: images, EXIF data, tables, configurations, cards, networks and paths that Hypothesis makes, each
given to a real command in a process of its own, with limits of time and memory.

A command may refuse an input, with one sentence and exit code 1 or 2, or use it. Counted is what it may not do: end
with a traceback, not end, end with another code, a signal or without a sentence, or print a control character or a
password.
"""

import os
import resource
import subprocess
import sys
from collections import namedtuple
from collections.abc import Callable, Iterator
from io import BytesIO
from itertools import count as numbers
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import hypothesis
import numpy as np
from base import Row
from hypothesis import strategies as st
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

LIMIT_S = 60.0  # far more than any of these commands takes on its own
MEMORY_BYTES = 4 << 30  # of addresses, of which the libraries alone take a good part
WRONGS = ("tracebacks", "hangs", "wrong_exit_codes", "leaks")
TEXTS = (
    "", " ", "-1", "1e308", "1e400", "nan", "-inf", "1466699519000", "9" * 400, "0x" + "f" * 5000, "x" * 5000, "\0",
    "9999-12-31T23:59:59+14:00", "2016:06:23 16:31:59", "2016-02-30", "\x1b[31m", "a\nb", "'", '"', ",", "\u202e", "½",
)  # fmt: skip
YAML_VALUES = (
    *TEXTS, "[]", "{a: 1}", "null", ".nan", "1:59:59", "0o777", "2001-01-01", r'"\0"', r'"\ud800"', r'"\x1b[31m"', "*a",
    "!!python/object/apply:os.system [id]", "!!binary eA==", "!!set {a, b}", "&a [*a]", "|", "- a", "[" * 50_000,
    "{a: " * 200, "[" + "x, " * 5000 + "x]",
)  # fmt: skip
PATHS = (
    "", " ", ".", "/", "~", "-", "..", "pipe", "plain", "plain/x", "/dev/null", "/dev/zero", "/dev/full", "$(id)",
    "/proc/self/mem", "/proc/self/fd/0", "x" * 300, "/x" * 3000, "a\nb", "\x1b[31m", "\u202e", "file:///etc/passwd",
    b"\xff\xfe", b"\xed\xa0\x80.yaml", "rtsp://pilot:secret@127.0.0.1:1/x", "http://[::1", "tcp://127.0.0.1:99999",
)  # fmt: skip
POSITIONS = "file,lat,lon,alt,yaw_deg,time\n0.jpg,50,8,100,10,1466699519"
TRUTH = "query_file,ref_files,ref_files_loose,status\n0.jpg,0.jpg,,ok"
CONFIGURATION = """\
board: this
technique: null
match:
  candidates: 42
  min_score: 0.1
memory:
  budget_mb: 20
mavlink:
  component_id: 197
  send_fixes: true
  min_accuracy_m: 5
battery:
  pack: 4S5200"""


# Writes the hostile file into a folder, and returns the command that is given it.
Attempt = Callable[[Path], list[str | bytes]]


# What hostile files are put beside: a folder with two pictures, a map of them, a network and its card.
Ground = namedtuple("Ground", "pictures map network card")


def run(count: int, seed: int) -> list[Row]:
    """Try `count` inputs of each kind; the same seed makes the same inputs. What went wrong is printed."""
    with TemporaryDirectory() as folder:
        ground = made(Path(folder))
        return [_tried(kind, attempts, Path(folder), count, seed) for kind, attempts in kinds(ground).items()]


def made(folder: Path) -> Ground:
    """Write harmless files, and map the pictures among them."""
    pictures = folder / "pictures"
    pictures.mkdir()
    for number in range(2):
        (pictures / f"{number}.jpg").write_bytes(picture(number=number))
    subprocess.run([sys.executable, "-m", "edgevpr", *_built(folder, pictures)], check=True, capture_output=True)
    models = Path(__file__).parents[1] / "models"
    lines = (models / "calc.yaml").read_text("utf-8").splitlines(keepends=True)
    card = "".join(line for line in lines if not line.startswith("sha256"))
    return Ground(str(pictures), str(folder / "m.gpkg"), str(models / "calc.onnx"), card)


def kinds(ground: Ground) -> dict[str, st.SearchStrategy[Attempt]]:
    """Return what makes the attempts of each kind."""

    def given(name: str, contents: st.SearchStrategy[bytes], *command: str) -> st.SearchStrategy[Attempt]:
        """Write a file of such contents, in place of which FILE stands in the command, and HERE of its folder."""

        def attempt(content: bytes, here: Path) -> list[str | bytes]:
            (here / name).write_bytes(content)
            (here / "net.yaml").write_text(ground.card, "utf-8")
            return [each.replace("FILE", str(here / name)).replace("HERE", str(here)) for each in command]

        return contents.map(lambda content: lambda here: attempt(content, here))

    build = _built(Path("HERE"), Path(ground.pictures))
    asked = ("match", ground.map, "--images")
    data = ("eval", "--techniques", "seqslam", "--query", ground.pictures, "--ref")
    flown = ("--source", ground.pictures, "--map", ground.map, "--log", "HERE/log")
    whole = Path(ground.network).read_bytes()

    def at_path(command: tuple[str, ...], path: str | bytes, here: Path) -> list[str | bytes]:
        os.mkfifo(here / "pipe")
        (here / "plain").touch()
        path = str(here / path) if path in ("pipe", "plain", "plain/x") else path
        return [path if each == "FILE" else each for each in command]

    commands = (
        (*asked, "FILE"),
        (*asked, ground.pictures, "--positions", "FILE"),
        (*asked, ground.pictures, "--board", "FILE"),
        *((*command, "--config", "FILE") for command in (("run",), ("check",), ("service", "print"))),
        ("models", "add", "FILE", "--card", "none.yaml"),
        ("models", "add", ground.network, "--card", "FILE"),
        (*data, ground.pictures, "--ground-truth", "FILE"),
    )
    return {
        "images": st.one_of(
            given(f"a{end}", damaged(picture(end)), *asked, "HERE") for end in (".jpg", ".png", ".tif", ".webp")
        ),
        "EXIF": given("a.jpg", with_exif(), *_built(Path("HERE"), Path("HERE"))),
        "positions.csv": given("p.csv", table(POSITIONS), *build, "--positions", "FILE"),
        "ground truth": given("t.csv", table(TRUTH), *data, ground.pictures, "--ground-truth", "FILE"),
        # A configuration that is right by chance flies over two pictures, and ends.
        "configurations": given("c.yaml", yaml(CONFIGURATION), "run", "--config", "FILE", *flown),
        "cards": given("card.yaml", yaml(ground.card), "models", "add", ground.network, "--card", "FILE"),
        "networks": given("net.onnx", damaged(whole), "models", "add", "FILE", "--card", "HERE/net.yaml"),
        "paths": st.builds(
            lambda command, path: lambda here: at_path(command, path, here),
            st.sampled_from(commands),
            st.sampled_from(PATHS),
        ),
    }


def _built(here: Path, pictures: Path) -> tuple[str, ...]:
    # Without a technique to insist on, each would first be tried in a process of its own.
    return ("map", "build", str(here / "m.gpkg"), "--images", str(pictures), "--technique", "cohog")


def picture(extension: str = ".jpg", number: int = 0) -> bytes:
    """A picture of 160x120 with some texture, encoded."""
    noise = np.random.default_rng(number).integers(0, 256, (30, 40, 3), np.uint8)
    return cv2.imencode(extension, cv2.resize(noise, (160, 120), interpolation=cv2.INTER_CUBIC))[1].tobytes()


def damaged(whole: bytes) -> st.SearchStrategy[bytes]:
    """A file that is cut, or of which some bytes are others, most of them near its beginning."""

    def changed(edits: list[tuple[int, int]]) -> bytes:
        content = bytearray(whole)
        for at, byte in edits:
            content[at % len(whole)] = byte
        return bytes(content)

    ends = st.integers(0, len(whole) - 1)
    edits = st.lists(st.tuples(st.integers(0, 399) | ends, st.integers(0, 255)), min_size=1, max_size=32)
    return ends.map(lambda end: whole[:end]) | edits.map(changed)


def with_exif() -> st.SearchStrategy[bytes]:
    """A JPEG with EXIF whose degrees and dates are senseless, and sometimes its bytes too."""
    numbers_of = st.sampled_from((0, 1, 2, 59, 60, 99, 255, 2**31, 2**32 - 1))
    degrees = st.tuples(*[st.builds(IFDRational, numbers_of, st.just(1) | numbers_of)] * 3)

    def jpeg(lat, lon, time, texts: list[str]) -> bytes:
        exif, file = Image.Exif(), BytesIO()
        exif.get_ifd(0x8825).update(
            {1: "N", 2: lat, 3: "E", 4: lon, 6: lat[0], 7: time, 16: "T", 17: lon[0], 29: texts[0]}
        )
        exif.get_ifd(0x8769).update({0x9003: texts[1], 0x9011: texts[2][:90]})
        Image.open(BytesIO(picture())).save(file, "jpeg", exif=exif)
        return file.getvalue()

    texts = st.lists(st.sampled_from(TEXTS), min_size=3, max_size=3)
    return st.builds(jpeg, degrees, degrees, degrees, texts).flatmap(lambda whole: st.just(whole) | damaged(whole))


def table(text: str) -> st.SearchStrategy[bytes]:
    """A CSV of which one cell is hostile, or the encoding."""
    rows = [line.split(",") for line in text.split("\n")]

    def one(row: int, column: int, cell: str, encoding: str) -> bytes:
        cells = [[cell if (row, column) == (i, j) else own for j, own in enumerate(own)] for i, own in enumerate(rows)]
        return "\n".join(map(",".join, cells)).encode(encoding, "replace")

    cells = st.sampled_from(TEXTS) | st.text(max_size=40)
    where = (st.integers(0, len(rows) - 1), st.integers(0, len(rows[0]) - 1))
    return st.builds(one, *where, cells, st.sampled_from(("utf-8", "utf-8", "utf-8-sig", "utf-16")))


def yaml(text: str) -> st.SearchStrategy[bytes]:
    """A YAML file of which one value is hostile, one line stands there twice, or some bytes are changed."""
    lines = text.splitlines()

    def one(at: int, value: str | None) -> bytes:
        line = lines[at] if value is None else f"{lines[at].partition(': ')[0]}: {value}"
        kept = lines[: at + (value is None)]
        return "\n".join([*kept, line, *lines[at + 1 :]]).encode("utf-8", "replace")

    values = st.none() | st.integers(0, len(YAML_VALUES) - 1).map(YAML_VALUES.__getitem__)  # too long to be printed
    return st.builds(one, st.integers(0, len(lines) - 1), values) | damaged(text.encode())


def _tried(kind: str, attempts: st.SearchStrategy[Attempt], folder: Path, count: int, seed: int) -> Row:
    found, number = dict.fromkeys(WRONGS, 0), numbers()
    every = {"phases": [hypothesis.Phase.generate], "suppress_health_check": list(hypothesis.HealthCheck)}

    @hypothesis.seed(seed)
    @hypothesis.settings(max_examples=count, deadline=None, database=None, **every)
    @hypothesis.given(attempts)
    def trial(attempt: Attempt) -> None:
        here = folder / f"{kind} {next(number)}"
        here.mkdir()
        command = attempt(here)
        for wrong, said in wrongs(command, here):
            found[wrong] += 1
            print(f"{wrong}: edgevpr {[os.fsdecode(word) for word in command]!a:.300}: ... {said[-900:]!a}", flush=True)

    trial()
    return {"kind": kind, "tried": next(number), **found}


def wrongs(command: list[str | bytes], here: Path) -> Iterator[tuple[str, str]]:
    """Run the command, and yield what it did wrong, with what it said."""
    try:
        done = subprocess.run(
            [sys.executable, "-m", "edgevpr", *command],
            capture_output=True,
            stdin=subprocess.DEVNULL,
            timeout=LIMIT_S,
            env={**os.environ, "EDGEVPR_MODELS": str(here / "models"), "XDG_DATA_HOME": str(here / "data")},
            preexec_fn=_limited,
        )
    except subprocess.TimeoutExpired as late:
        yield "hangs", os.fsdecode((late.stderr or b"")[-500:])
        return
    said = os.fsdecode(done.stderr[-2000:])
    if b"Traceback (most" in done.stderr:
        yield "tracebacks", said
    is_said = b"edgevpr: " in done.stderr or b"usage: " in done.stderr or command[0] == "check"
    if done.returncode not in (0, 1, 2) or (done.returncode and not is_said):
        yield "wrong_exit_codes", f"{done.returncode} {said}"
    if b"\x1b" in done.stdout + done.stderr or b"secret" in done.stdout + done.stderr:
        yield "leaks", said


def _limited() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
