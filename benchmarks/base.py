"""What all benchmarks share: folders, JSON results and their provenance, Markdown tables, and plots."""

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
# Helpers of the tests (loopback cameras, large maps, flight processes), and the recipes that write networks.
sys.path += [str(REPOSITORY / name) for name in ("tests", "tests/mavlink", "tests/runtime", "models/recipes")]
RESULTS = REPOSITORY / "benchmarks" / "results"
DATA = Path(os.environ.get("EDGEVPR_DATA") or REPOSITORY.parent / "shared" / "data")
TUNING_SETS = ("corridor", "aerial_caliterra", "aerial_garfield28", "sat_marash", "thumbs_essex")
AERIAL_PREFIXES = ("aerial_", "kite_", "sat_")  # names of sets whose camera looks down
Row = dict[str, Any]


def run(main: Callable[[], object], opencv_threads: int | None = 1) -> None:
    """Run a script's `main` on one OpenBLAS thread, and exit with its status. OpenBLAS reads its number of threads when
    NumPy is loaded, so Python starts again if the number is not set. `opencv_threads`: None for OpenCV's default, as in
    edgevpr's commands. An EdgevprError ends the script with its message."""
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


def describe_run() -> Row:
    """Return the date, commit and machine of a measurement."""
    origin = provenance.describe_origin()
    versions = {"python": platform.python_version(), "numpy": np.__version__, "opencv": cv2.__version__}
    return {"date": origin["date"], "commit": read_commit(), "machine": {**origin["machine"], **versions}}


@cache
def read_commit(repository: Path = REPOSITORY) -> str:
    """Return the commit of a repository, followed by " with changes" if edgevpr/ or models/ differ from it."""
    is_changed = bool(_run_git(repository, "status", "--porcelain", "--", "edgevpr", "models"))
    return _run_git(repository, "rev-parse", "--short", "HEAD") + " with changes" * is_changed or "unknown"


def read_program_commit(repository: Path) -> str:
    """Return the last commit that changed edgevpr/ or models/: no other file changes the program."""
    last = _run_git(repository, "log", "-1", "--format=%h", "--", "edgevpr", "models")
    return last + " with changes" * read_commit(repository).endswith("changes") or "unknown"


def _run_git(repository: Path, *words: str) -> str:
    """Return the output of a git command; an empty text if it fails or there is no git."""
    command = ("git", "-C", str(repository), *words)
    return subprocess.run(command, capture_output=True, text=True).stdout.strip() if shutil.which("git") else ""


def read(name: str, folder: Path = RESULTS) -> Row:
    """Return the content of NAME.json; {} if there is no such file."""
    path = folder / f"{name}.json"
    return json.loads(path.read_text(), object_hook=restore_rows) if path.exists() else {}


def read_csv(path: Path) -> list[dict[str, str]]:
    with open(path, newline="") as handle:
        return list(csv.DictReader(handle))


def write(name: str, content: Row, page: str, folder: Path = RESULTS) -> None:
    """Write NAME.json and NAME.md."""
    write_json(name, content, folder)
    (folder / f"{name}.md").write_text(page.strip() + "\n")


def write_json(name: str, content: Row, folder: Path = RESULTS) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / f"{name}.json").write_text(format_json(round_floats(content), 0) + "\n")


def format_json(value: Any, longest: int = 2000) -> str:
    """Return JSON text, with a line for each item of a value longer than `longest` characters. A list of rows with the
    same keys becomes {"columns": ..., "rows": ...}."""
    text = json.dumps(value)
    if not isinstance(value, dict | list) or len(text) <= longest:
        return text
    if isinstance(value, list) and all(isinstance(row, dict) and row.keys() == value[0].keys() for row in value):
        value = {"columns": list(value[0]), "rows": [[row[key] for key in value[0]] for row in value]}
    if isinstance(value, dict):
        items = [f"{json.dumps(key)}: {format_json(item)}" for key, item in value.items()]
    else:
        items = [format_json(item) for item in value]
    first, last = "{}" if isinstance(value, dict) else "[]"
    return "\n".join((first, ",\n".join(items), last))


def restore_rows(value: Row) -> Any:
    """Return the list of rows that `format_json` wrote as columns and rows; any other object unchanged."""
    is_table = value.keys() == {"columns", "rows"}
    return [dict(zip(value["columns"], row, strict=True)) for row in value["rows"]] if is_table else value


def round_floats(value: Any) -> Any:
    """Return JSON content with at most six significant digits: no page shows more."""
    if isinstance(value, float):
        return float(f"{value:.6g}")
    if isinstance(value, Mapping):
        return {key: round_floats(item) for key, item in value.items()}
    return [round_floats(item) for item in value] if isinstance(value, list | tuple) else value


def format_origin(content: Row, command: str) -> str:
    """Return the last line of a page: commit, date, processor and command."""
    return f"Commit {content['commit']}, {content['date']}, {content['machine']['cpu']}. Made by `{command}`."


def strip_title(doc: str, until: str | None = None) -> str:
    """Return a script's docstring for its page: without the first paragraph, and only up to `until`."""
    text = doc.partition("\n\n")[2]
    return (text.partition(until)[0] if until else text).strip()


def format_table(rows: Iterable[Mapping[str, Any]], columns: Mapping[str, str], left: int = 1) -> str:
    """Return rows as a Markdown table. `columns` maps headings to templates such as "{error[median_m]:.1f}"; a value
    that a row lacks, or that is None, is shown as "-"."""
    cells = [[format_cell(template, row) for template in columns.values()] for row in rows]
    return format_markdown_table(list(columns), cells, left)


def format_markdown_table(headings: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> str:
    """Return a Markdown table: the first `left` columns left-aligned, the others right-aligned."""
    ruler = ["---"] * left + ["---:"] * (len(headings) - left)
    return "\n".join("| " + " | ".join(line) + " |" for line in (headings, ruler, *rows))


def format_cell(template: str, row: Mapping[str, Any]) -> str:
    """Fill in a template of `format_table`."""
    try:
        text = template.format_map(row)
    except (KeyError, IndexError, TypeError):
        return "-"
    return "-" if "None" in text else text


def find_use(name: str) -> str:
    """Return "tune" if parameters were chosen on a set, or "report" if its figures are only reported."""
    return "tune" if name in TUNING_SETS else "report"


def infer_camera(name: str) -> str:
    """Return the direction of a set's camera, nadir or forward."""
    return "nadir" if name.startswith(AERIAL_PREFIXES) else "forward"


def find_sets(data: Path = DATA, names: Iterable[str] | None = None, camera: str | None = None) -> list[Path]:
    """Return the folders of `data` that have a ground truth: all, those in `names`, or those of one camera. Raises
    UsageError if one is missing."""
    folders = {path.parent.name: path.parent for path in sorted(data.glob("*/ground_truth.csv"))}
    wanted = list(folders) if names is None else list(names)
    missing = [name for name in wanted if name not in folders]
    if missing or not folders:
        problem = f"no set `{missing[0]}`" if missing else "no image sets (folders with a ground_truth.csv)"
        raise UsageError(f"Found {problem} in {data}: set EDGEVPR_DATA to the folder of the image sets.")
    return [folder for name, folder in folders.items() if name in wanted and camera in (None, infer_camera(name))]


def run_edgevpr(*arguments: object) -> Any:
    """Run an edgevpr command with `--json`, and return its parsed output. Raises EdgevprError if it fails."""
    words = [sys.executable, "-m", "edgevpr", *map(str, arguments), "--json"]
    process = subprocess.run(words, stdout=subprocess.PIPE, text=True)
    if process.returncode:
        raise EdgevprError(f"`{' '.join(words[2:])}` failed: see its message above.")
    return json.loads(process.stdout)


def make_panels(width_in: float, height_in: float, count: int, rows: int = 1, **shared: Any) -> tuple[Any, list[Any]]:
    """Return a figure and its `count` axes, in `rows` rows, each with a grid. `shared`: arguments of `subplots`."""
    from matplotlib.figure import Figure  # not every benchmark draws

    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    axes = list(figure.subplots(rows, -(-count // rows), squeeze=False, **shared).ravel())
    for axis in axes[:count]:
        axis.grid(alpha=0.3)
        axis.tick_params(labelsize=8)
    for axis in axes[count:]:
        axis.set_visible(False)
    return figure, axes[:count]


def save_figure(figure: Any, path: Path, dpi: int = 80) -> None:
    """Save a figure as a PNG of 64 colours."""
    from PIL import Image

    figure.savefig(path, dpi=dpi)
    Image.open(path).convert("RGB").quantize(64, dither=Image.Dither.NONE).save(path, optimize=True)


def measure_once(path: Path, measure: Callable[[], Any]) -> Any:
    """Return the content of the file `path`; if it is missing, measure and write it, so an interrupted run resumes."""
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        unfinished = path.with_name(f"{path.name}.unfinished")
        unfinished.write_text(json.dumps(measure()))
        unfinished.replace(path)
    return json.loads(path.read_text())


def group_rows(rows: Iterable[Row], key: Callable[[Row], Any]) -> Iterator[tuple[Any, list[Row]]]:
    """Yield each value of `key` and its rows, in the order in which the values first occur."""
    groups: dict[Any, list[Row]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    yield from groups.items()


def thin_evenly(items: Sequence[Any], count: int) -> list[Any]:
    """Return at most `count` of the items, evenly spread."""
    numbers = np.linspace(0, len(items) - 1, min(len(items), count)).round().astype(int)
    return [items[number] for number in np.unique(numbers)]
