"""Shared by all benchmarks: where images and results lie, who made a figure, and tables, pages and pictures of rows."""

import csv
import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from edgevpr.core.errors import EdgevprError, UsageError
from edgevpr.lab.evaluate import provenance

REPOSITORY = Path(__file__).resolve().parents[1]
# The tests' tools (cameras on loopback, large maps, flights as processes), and the writing of networks.
sys.path += [str(REPOSITORY / name) for name in ("tests", "tests/mavlink", "tests/runtime", "models/recipes")]
RESULTS = REPOSITORY / "benchmarks" / "results"
DATA = Path(os.environ.get("EDGEVPR_DATA") or REPOSITORY.parent / "shared" / "data")
TUNED_ON = ("corridor", "aerial_caliterra", "aerial_garfield28", "sat_marash", "thumbs_essex")
FROM_THE_AIR = ("aerial_", "kite_", "sat_")  # how the names of such sets begin
Row = dict[str, Any]


def run(main: Callable[[], object], opencv_threads: int | None = 1) -> None:
    """Run a script on one thread of NumPy's library, whose number is read when NumPy is loaded, and with so many of
    OpenCV (None: as edgevpr's commands run). What edgevpr cannot do ends it with a sentence."""
    if "OPENBLAS_NUM_THREADS" not in os.environ:
        os.environ["OPENBLAS_NUM_THREADS"] = "1"
        os.execv(sys.executable, sys.orig_argv)
    if opencv_threads:
        cv2.setNumThreads(opencv_threads)
    try:
        sys.exit(main())
    except EdgevprError as error:
        print(f"{Path(sys.argv[0]).stem}: {error}", file=sys.stderr)
        sys.exit(error.exit_code)


def made_by() -> Row:
    """Return the date, the commit and the machine of a measurement."""
    versions = {"python": platform.python_version(), "numpy": np.__version__, "opencv": cv2.__version__}
    return {
        "date": provenance.format_date(),
        "commit": commit(),
        "machine": {**provenance.describe_machine(), **versions},
    }


@cache
def commit(repository: Path = REPOSITORY) -> str:
    """Return the commit of a repository that is measured, and whether something has changed since."""
    if not shutil.which("git"):
        return "unknown"
    asked = (("rev-parse", "--short", "HEAD"), ("status", "--porcelain", "--", "edgevpr", "models"))
    of = ("git", "-C", str(repository))
    head, changed = (subprocess.run([*of, *words], capture_output=True, text=True).stdout.strip() for words in asked)
    return head + (" with changes" if changed else "") or "unknown"


def program_commit(repository: Path) -> str:
    """Return what identifies the edgevpr of a repository: no other file changes it."""
    asked = ("git", "-C", str(repository), "log", "-1", "--format=%h", "--", "edgevpr", "models")
    last = subprocess.run(asked, capture_output=True, text=True).stdout.strip() if shutil.which("git") else ""
    return last + " with changes" * commit(repository).endswith("changes") or "unknown"


def read(name: str, folder: Path = RESULTS) -> Row:
    """Return the content of NAME.json; {} where it is not there."""
    path = folder / f"{name}.json"
    return json.loads(path.read_text(), object_hook=from_columns) if path.exists() else {}


def read_csv(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as handle:
        return list(csv.DictReader(handle))


def write(name: str, found: Row, page: str, folder: Path = RESULTS) -> None:
    """Write NAME.json and NAME.md."""
    write_json(name, found, folder)
    (folder / f"{name}.md").write_text(page.strip() + "\n")


def write_json(name: str, found: Row, folder: Path = RESULTS) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.json").write_text(row_by_row(rounded(found), 0) + "\n")


def row_by_row(value: Any, longest: int = 2000) -> str:
    """Return JSON in which what is longer than so many characters has a line for each of its items; rows of the same
    keys are kept as columns and rows."""
    text = json.dumps(value)
    if not isinstance(value, dict | list) or len(text) <= longest:
        return text
    if isinstance(value, list) and all(isinstance(row, dict) and row.keys() == value[0].keys() for row in value):
        value = {"columns": list(value[0]), "rows": [[row[key] for key in value[0]] for row in value]}
    if isinstance(value, dict):
        items = [f"{json.dumps(key)}: {row_by_row(each)}" for key, each in value.items()]
    else:
        items = [row_by_row(each) for each in value]
    first, last = "{}" if isinstance(value, dict) else "[]"
    return "\n".join((first, ",\n".join(items), last))


def from_columns(value: Row) -> Any:
    """Return what `row_by_row` has kept as columns and rows."""
    is_table = value.keys() == {"columns", "rows"}
    return [dict(zip(value["columns"], row, strict=True)) for row in value["rows"]] if is_table else value


def rounded(value: Any) -> Any:
    """Return JSON content with at most six significant digits: no page shows more."""
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, Mapping):
        return {key: rounded(each) for key, each in value.items()}
    return [rounded(each) for each in value] if isinstance(value, list | tuple) else value


def made_line(found: Row, command: str) -> str:
    """Return the sentence that ends a page."""
    return f"Commit {found['commit']}, {found['date']}, {found['machine']['cpu']}. Made by `{command}`."


def told(doc: str, until: str | None = None) -> str:
    """Return the docstring of a script for its page: without its first line, and without what follows `until`."""
    text = doc.partition("\n\n")[2]
    return (text.partition(until)[0] if until else text).strip()


def table(rows: Iterable[Mapping[str, Any]], columns: Mapping[str, str], left: int = 1) -> str:
    """Return rows as a Markdown table. A column is its heading and a template such as "{error[median_m]:.1f}"; what a
    row lacks, or has as None, is "-"."""
    return format_markdown_table(list(columns), [[cell(each, row) for each in columns.values()] for row in rows], left)


def format_markdown_table(headings: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> str:
    """Return a Markdown table: the first `left` columns left-aligned, the others right-aligned."""
    ruler = ["---"] * left + ["---:"] * (len(headings) - left)
    return "\n".join("| " + " | ".join(line) + " |" for line in (headings, ruler, *rows))


def cell(template: str, row: Mapping[str, Any]) -> str:
    """Fill in a template of `table`."""
    try:
        text = template.format_map(row)
    except (KeyError, IndexError, TypeError):
        return "-"
    return "-" if "None" in text else text


def use_of(name: str) -> str:
    """Return whether parameters were chosen with a set (`tune`), or its figures are only reported (`report`)."""
    return "tune" if name in TUNED_ON else "report"


def camera_of(name: str) -> str:
    """Return the way the camera of a set looks."""
    return "nadir" if name.startswith(FROM_THE_AIR) else "forward"


def find_sets(data: Path = DATA, names: Iterable[str] | None = None, camera: str | None = None) -> list[Path]:
    """Return the folders of `data` that have a ground truth: all, those named, or those of a camera. Raises UsageError
    where one is missing."""
    found = {path.parent.name: path.parent for path in sorted(data.glob("*/ground_truth.csv"))}
    wanted = list(found) if names is None else list(names)
    missing = [name for name in wanted if name not in found]
    if missing or not found:
        what = f"no set `{missing[0]}`" if missing else "no image sets (folders with a ground_truth.csv)"
        raise UsageError(f"There are {what} in {data}: name the right folder with EDGEVPR_DATA.")
    return [folder for name, folder in found.items() if name in wanted and camera in (None, camera_of(name))]


def edgevpr(*arguments: object) -> Any:
    """Return what a command of edgevpr prints as JSON, by `--json`. Raises EdgevprError where it fails."""
    words = [sys.executable, "-m", "edgevpr", *map(str, arguments), "--json"]
    done = subprocess.run(words, stdout=subprocess.PIPE, text=True)
    if done.returncode:
        raise EdgevprError(f"`{' '.join(words[2:])}` failed (see above): correct what it names.")
    return json.loads(done.stdout)


def figure(wide_in: float, high_in: float) -> Any:
    """Make an empty figure of so many inches."""
    from matplotlib.figure import Figure  # not every benchmark draws

    return Figure(figsize=(wide_in, high_in), layout="constrained")


def panels(wide_in: float, high_in: float, count: int, rows: int = 1, **shared: Any) -> tuple[Any, list[Any]]:
    """Return a figure of so many inches with `count` panels in `rows`, each with a grid, and its axes."""
    drawn = figure(wide_in, high_in)
    axes = list(drawn.subplots(rows, -(-count // rows), squeeze=False, **shared).ravel())
    for each in axes[:count]:
        each.grid(alpha=0.3)
        each.tick_params(labelsize=8)
    for each in axes[count:]:
        each.set_visible(False)
    return drawn, axes[:count]


def save(drawn: Any, path: Path, dpi: int = 80) -> None:
    """Save a figure as a picture of few bytes."""
    drawn.savefig(path, dpi=dpi)
    shrink(path)


def shrink(path: Path) -> None:
    """Reduce a PNG to 64 colours."""
    from PIL import Image

    Image.open(path).convert("RGB").quantize(64, dither=Image.Dither.NONE).save(path, optimize=True)


def kept(path: Path, measure: Callable[[], Any]) -> Any:
    """Return what a file of `path` has; where it is not there, measure it and keep it: an interrupted run goes on."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_name(f"{path.name}.unfinished")
        unfinished.write_text(json.dumps(measure()))
        unfinished.replace(path)
    return json.loads(path.read_text())


def groups(rows: Iterable[Row], key: Callable[[Row], Any]) -> Iterator[tuple[Any, list[Row]]]:
    """Yield rows by what `key` says of them, in the order of their first ones."""
    found: dict[Any, list[Row]] = {}
    for row in rows:
        found.setdefault(key(row), []).append(row)
    yield from found.items()
