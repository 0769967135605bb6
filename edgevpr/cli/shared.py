"""Code shared by the commands: flags, the configuration made from them, and the printing of results and errors."""

import argparse
import json
import re
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict, is_dataclass
from pathlib import Path
from textwrap import wrap
from typing import Any

from edgevpr.cli.examples import format_examples
from edgevpr.core.config import Config, list_keys, load_config
from edgevpr.core.errors import ImageError, UsageError
from edgevpr.core.text import sanitize, suggest

Run = Callable[[argparse.Namespace], int | None]  # runs a command with its arguments; returns its exit code (None: 0)
_PREFIX = "key "  # prefix of `Namespace` attributes that hold configuration keys
_HELP_COLUMNS = 78
_UNITS = {
    "s": " s", "ms": " ms", "m": " m", "mb": " MB", "bytes": " bytes", "c": " °C", "deg": "°", "mah": " mAh", "w": " W"
}  # fmt: skip


class Parser(argparse.ArgumentParser):
    """Parser of a command. The error for an invalid choice suggests a similar one. Arguments that begin as a negative
    number, as in `--area -35.36,149.16,500`, are values, not flags."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._negative_number_matcher = re.compile(r"-\.?\d")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices and (hint := suggest(value, action.choices, "")):
            raise argparse.ArgumentError(action, f"invalid choice: {value!r}; {hint}")
        super()._check_value(action, value)


def add_command(commands: Any, name: str, run: Run, text: str) -> argparse.ArgumentParser:
    """Add a command and return its parser. `text` is the command's help."""
    parser = _add_parser(commands, name, text)
    parser.set_defaults(run=run, parser=parser)
    parser.epilog = format_examples(parser.prog.partition(" ")[2])
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    return parser


def add_group(commands: Any, name: str, text: str) -> Any:
    """Add a command that has subcommands, such as `map`, and return the object to add them to."""
    return _add_parser(commands, name, text).add_subparsers(title="commands", required=True, metavar="COMMAND")


def _add_parser(commands: Any, name: str, text: str) -> argparse.ArgumentParser:
    description = "\n".join(wrap(text[0].upper() + text[1:] + ".", _HELP_COLUMNS))
    parser: argparse.ArgumentParser = commands.add_parser(name, help=text, description=description)
    # Accepted after the command too, where users type them.
    parser.add_argument("-v", "--debug", action="store_true", default=argparse.SUPPRESS, help=argparse.SUPPRESS)
    parser.add_argument("-q", "--quiet", action="store_true", default=argparse.SUPPRESS, help=argparse.SUPPRESS)
    return parser


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add the flag --json."""
    parser.add_argument("--json", action="store_true", help="print JSON")


def add_recording(parser: argparse.ArgumentParser, required: bool = True) -> None:
    """Add the flags for the folder of images or the video, and for its positions."""
    text = "folder of images, or video file"
    parser.add_argument("--images", "--source", dest="source", required=required, metavar="SOURCE", help=text)
    add_positions(parser)


def add_positions(parser: argparse.ArgumentParser) -> None:
    """Add the flag for the positions of a folder of images or a video."""
    parser.add_argument(
        "--positions",
        metavar="CSV",
        help="CSV file with the columns file,lat,lon[,alt,yaw_deg,roll_deg,pitch_deg,height_m,time] (default: "
        "positions.csv next to the images); for a video: time,lat,lon[,...], with time in seconds from its first frame",
    )


def add_map_images(parser: argparse.ArgumentParser) -> None:
    """Add the flag for the pictures that a map was built from, for pages that show them."""
    text = "images (folder, repeatable), video or orthophoto that the map was built from"
    parser.add_argument("--map-images", action="append", default=[], metavar="DIR", help=text)


def add_known(parser: argparse.ArgumentParser) -> None:
    """Add the flag for prior knowledge about recorded queries; `hints.parse_known_fields` parses its value."""
    parser.add_argument(
        "--known",
        metavar="A,B",
        help="prior knowledge about each query, as in flight: heading (yaw_deg in positions.csv), height (height_m of "
        "queries and places, or the map's height), reach (a position within 300 m)",
    )


def add_parameters(parser: argparse.ArgumentParser, text: str, form: str = "KEY=VALUE") -> None:
    """Add the repeatable flag --param for parameters of a technique. `text` is its help."""
    parser.add_argument("--param", action="append", default=[], metavar=form, help=text)


def add_keys(parser: argparse.ArgumentParser, *names: str) -> None:
    """Add the flags of the configuration keys `names`, such as "source.mask" (no names: the flags of all keys)."""
    for key in list_keys():
        if not key.flags or (names and key.name not in names):
            continue
        form: dict[str, Any] = {"type": key.kind, "metavar": key.metavar, "choices": key.choices or None}
        if key.kind is bool:
            form = {"action": "store_const", "const": key.sets}
        parser.add_argument(*key.flags, dest=_PREFIX + key.name, help=key.text, **form)


def make_config(args: argparse.Namespace, path: str | None = None, **overrides: Any) -> Config:
    """Make the configuration from the file `path` (None: the defaults). Flags override the file, and `overrides`
    (values by configuration key) override both."""
    flags = {name.removeprefix(_PREFIX): value for name, value in vars(args).items() if name.startswith(_PREFIX)}
    return load_config(path, flags | overrides)


def parse_parameters(pairs: list[str]) -> dict[str, str]:
    """Parse ["gt=0.4"] into {"gt": "0.4"}. Raises UsageError for any other format."""
    for pair in pairs:
        if "=" not in pair:
            raise UsageError(f"--param {pair} must be KEY=VALUE, for example gt=0.4.")
    return dict(pair.split("=", 1) for pair in pairs)


def to_path(text: str | None) -> Path | None:
    """Return the value of an optional flag as a path; None if it is None or empty."""
    return Path(text) if text else None


def skip_image(error: ImageError, unusable: list[ImageError]) -> None:
    """Report an image that cannot be used and append the error to `unusable`; the command continues without it."""
    print_notes(str(error))
    unusable.append(error)


def report_unusable(unusable: list[ImageError]) -> int:
    """Return the exit code 1, and print how many images could not be used, if there are any; else return 0."""
    if unusable:
        print_notes(f"{sum(error.count for error in unusable)} images could not be used (named above).")
    return 1 if unusable else 0


def print_result(value: Any, as_json: bool, text: str | Iterable[str] | None = None) -> None:
    """Print a result, a dataclass or a dictionary: as JSON for programs, or as `text` for people. Lines of `text` are
    sanitized; a single string is printed unchanged. `text` None: print a line for each field."""
    fields = asdict(value) if is_dataclass(value) and not isinstance(value, type) else value
    if as_json:
        print(json.dumps(fields, indent=2, default=str))
    else:
        lines = format_fields(fields) if text is None else text
        print(lines if isinstance(lines, str) else "\n".join(map(sanitize, lines)))


def describe_lost_calibration(path: str, is_lost: bool) -> list[str]:
    """Return a line on what to do with a map whose calibration `is_lost` by merging or cutting; else no lines."""
    problem = "not calibrated: the calibrations of its parts do not apply to it, so the default one is used"
    return [f"  {problem}; run edgevpr map calibrate {path}"] if is_lost else []


def format_fields(fields: dict[str, Any], indent: str = "") -> Iterator[str]:
    """Yield a line of text for each known field: its name, and its value with the unit from the end of the name. The
    lines of nested fields are indented; a list of rows or sentences gets one line for each."""
    for name, value in fields.items():
        words, _, ending = name.rpartition("_")
        unit = _UNITS.get(ending, "") if words else ""
        label = (words if unit else name).replace("_", " ")
        # The text of a dictionary or a row contains spaces too.
        is_list = isinstance(value, list | tuple) and any(" " in str(item) for item in value)
        for item in value if is_list else [value]:
            if isinstance(item, dict) and item:
                yield f"{indent}{label}:"
                yield from format_fields(item, f"{indent}  ")
            elif item not in (None, "", (), [], {}):
                yield f"{indent}{label:<18} {_format_value(item)}{unit}"


def _format_value(value: Any) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(map(_format_value, value))
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"
    return str(value)


def print_notes(*sentences: str) -> None:
    """Print sentences to stderr, each prefixed with the name of the program."""
    for sentence in sentences:
        print(f"edgevpr: {sanitize(sentence)}", file=sys.stderr)


def parse_positive(text: str) -> float:
    """Parse a finite number above zero; the `type` of a flag. Raises argparse.ArgumentTypeError for any other text."""
    with suppress(ValueError):
        if 0 < (value := float(text)) < float("inf"):
            return value
    raise argparse.ArgumentTypeError(f"`{text}` is not a number above 0")


def parse_count(text: str) -> int:
    """Parse a whole number above zero; the `type` of a flag. Raises argparse.ArgumentTypeError for any other text."""
    with suppress(ValueError):
        if (value := int(text)) > 0:
            return value
    raise argparse.ArgumentTypeError(f"`{text}` is not a whole number above 0")


def check_output(target: str, source: str) -> Path:
    """Return the path of the output file `target`. Raises UsageError if it is the `source`, or has no folder."""
    from edgevpr.core.files import require_folder

    path = Path(target)
    if path.exists() and Path(source).exists() and path.samefile(source):
        raise UsageError(f"{target} is the input file: pass another output file.")
    require_folder(path)
    return path


def write_output(target: str, source: str, text: str) -> None:
    """Write `text` to the file `target`, completely or not at all. Raises UsageError as `check_output` does."""
    from edgevpr.core.files import write_atomically

    content = text.encode("utf-8", "backslashreplace")
    write_atomically(check_output(target, source), lambda path: path.write_bytes(content))
