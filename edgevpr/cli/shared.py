"""Parts that the commands share: flags, the configuration made from them, and the printing of results and errors."""

import json
import sys
from argparse import SUPPRESS, ArgumentParser, Namespace
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from edgevpr.core.config import Config, keys_of, load_config
from edgevpr.core.errors import ImageError, UsageError
from edgevpr.core.text import shown

if TYPE_CHECKING:
    from edgevpr.core.types import Frame
    from edgevpr.frames.source import Source

T = TypeVar("T")
_KEY = "key "  # prefix of the attribute names of `Namespace` that hold keys of the configuration
_RECORDING = "a folder of images or a video file"


def command(commands: Any, name: str, run: Callable[[Namespace], int], text: str) -> ArgumentParser:
    """Add a command that calls `run` with the parsed arguments, and return its parser. `text` is its help; `run`
    returns the exit code."""
    parser = _parser(commands, name, text)
    parser.set_defaults(run=run)
    return parser


def group(commands: Any, name: str, text: str) -> Any:
    """Add a command that has subcommands, such as `map`, and return the object that those are added to."""
    return _parser(commands, name, text).add_subparsers(title="commands", required=True, metavar="COMMAND")


def _parser(commands: Any, name: str, text: str) -> ArgumentParser:
    parser: ArgumentParser = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
    # Accepted after the command too, where users type it.
    parser.add_argument("--debug", action="store_true", default=SUPPRESS, help=SUPPRESS)
    return parser


def add_json(parser: ArgumentParser) -> None:
    """Add the flag --json."""
    parser.add_argument("--json", action="store_true", help="print JSON")


def add_recording(parser: ArgumentParser, required: bool = True) -> None:
    """Add the flags for the images or the video that frames come from, and for their positions."""
    parser.add_argument("--images", "--source", dest="source", required=required, metavar="SOURCE", help=_RECORDING)
    add_positions(parser)


def add_positions(parser: ArgumentParser) -> None:
    """Add the flag for the positions that go with a folder of images or a video."""
    parser.add_argument(
        "--positions",
        metavar="CSV",
        help="file,lat,lon[,alt,yaw_deg,roll_deg,pitch_deg,height_m,time] (default: beside the images); of a video "
        "time,lat,lon[,...], in seconds from its first frame",
    )


def add_parameters(parser: ArgumentParser, text: str, form: str = "KEY=VALUE") -> None:
    """Add --param, for parameters of a technique or a vehicle. It may be repeated. `text` is its help."""
    parser.add_argument("--param", action="append", default=[], metavar=form, help=text)


def add_keys(parser: ArgumentParser, *names: str, **texts: str) -> None:
    """Add the flags of the configuration keys `names` (none: of all keys), such as "source.mask". `texts` replace the
    help of some; they are by the last part of the key's name, such as "mask"."""
    for key in keys_of():
        if not key.flags or (names and key.name not in names):
            continue
        text = texts.get(key.name.rpartition(".")[2], key.text)
        form: dict[str, Any] = {"type": key.kind, "metavar": key.metavar, "choices": key.choices or None}
        if key.kind is bool:
            form = {"action": "store_const", "const": key.sets}
        parser.add_argument(*key.flags, dest=_KEY + key.name, help=text, **form)


def value_of(args: Namespace, name: str) -> Any:
    """Return the value that the flags give for the configuration key `name`; None if they give none."""
    return getattr(args, _KEY + name)


def config_of(args: Namespace, path: str | None = None, **others: Any) -> Config:
    """Make the configuration from the file `path` (None: the defaults). Flags override it; `others`, by key, override
    both."""
    said = {name.removeprefix(_KEY): value for name, value in vars(args).items() if name.startswith(_KEY)}
    return load_config(path, said | others)


def parameters_of(pairs: list[str], example: str = "gt=0.4") -> dict[str, str]:
    """Read ["gt=0.4"] as {"gt": "0.4"}. Raises UsageError for another form."""
    for pair in pairs:
        if "=" not in pair:
            raise UsageError(f"--param {pair}: write KEY=VALUE, e.g. {example}.")
    return dict(pair.split("=", 1) for pair in pairs)


def path_of(text: str | None) -> Path | None:
    """Return `text`, the value of an optional flag, as a path; None if it is None or empty."""
    return Path(text) if text else None


def frames_of(source: "Source", label: str, unusable: list[ImageError]) -> "Iterator[Frame]":
    """Yield every frame of a source that ends (files, no camera), and show progress with `label`. An image that cannot
    be used is left out: it is reported, and its error added to `unusable`."""
    from edgevpr.core.text import progress
    from edgevpr.frames.source import read_to_end

    frames = read_to_end(source, lambda error: leave_out(error, unusable))
    return (frame for frame in progress(frames, source.total, label) if frame is not None)


def leave_out(error: ImageError, unusable: list[ImageError]) -> None:
    """Report that an image cannot be used, and add the error to `unusable`."""
    print(f"edgevpr: {shown(str(error))}", file=sys.stderr)
    unusable.append(error)


def exit_code(unusable: list[ImageError]) -> int:
    """Return the exit code: 1 if any image could not be used, and then print how many; else 0."""
    if unusable:
        count = sum(error.count for error in unusable)
        print(f"edgevpr: {count} images could not be used (named above).", file=sys.stderr)
    return 1 if unusable else 0


def print_json(value: Any) -> None:
    """Print a result as JSON, for programs."""
    print(json.dumps(value, indent=2, default=str))


def positive(text: str) -> float:
    """Read a finite number above zero, as the `type` of a flag. Raises ValueError for other texts."""
    value = float(text)
    if not 0 < value < float("inf"):
        raise ValueError
    return value


def watched(label: str) -> "Callable[[Iterable[T], int], Iterator[T]]":
    """Return a function that takes an iterable and its length, and yields its items while it shows progress."""
    from edgevpr.core.text import progress

    return lambda things, total: progress(things, total, label)
