"""Entry point of the `edgevpr` command line. Each module in `_GROUPS` adds a group of commands with their flags. A
command imports what it needs only when it runs, so help and short commands are fast."""

import argparse
import logging
import os
import sys
import threading
from functools import cache

from edgevpr import __version__
from edgevpr.cli import flying, lab, maps, positions, profile, review, top
from edgevpr.cli.screen import LineFormatter, guard_output
from edgevpr.cli.shared import Parser
from edgevpr.core.errors import EdgevprError
from edgevpr.core.text import sanitize, suggest

EXIT_CODES = {
    0: "Done, and nothing is wrong.",
    1: "A problem was found (by `check`, `doctor`, `map check`, `replay`), something was left out (an image, a "
    "technique), or a map, images, a link or a disk cannot be used. A retry may succeed.",
    2: "The request is wrong: the command line, the configuration, or a table or log that it names. Nothing was "
    "started. A retry would fail too, so systemd does not restart the service. `check` exits as `run` would.",
    130: "Stopped by Ctrl-C. `run` and `top`, which are meant to be stopped this way, exit with 0 or 1.",
}
_GROUPS = (positions, maps, flying, top, review, profile, lab)


def program() -> None:
    """Run the command in `sys.argv` and exit the process with its exit code."""
    if "_ARGCOMPLETE" in os.environ:  # the shell requests completions
        import argcomplete

        argcomplete.autocomplete(make_parser())
    code = main()
    if threading.active_count() > 1:
        # A capture thread is blocked on a stream that does not answer: on a normal exit FFmpeg would abort Python.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def main(argv: list[str] | None = None) -> int:
    """Run the command `argv` (None: `sys.argv`) and return its exit code, one of `EXIT_CODES`."""
    with guard_output():
        return _run(sys.argv[1:] if argv is None else argv)


def _run(argv: list[str]) -> int:
    args, unknown = make_parser().parse_known_args(argv)
    if unknown:
        hint = suggest(unknown[0].partition("=")[0], args.parser._option_string_actions, "")
        args.parser.error(f"unrecognized arguments: {' '.join(unknown)}{hint and '; '}{hint}")
    # Set before NumPy is imported: the matrix products are small, and more threads would only slow them down.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(LineFormatter("edgevpr: %(message)s"))
    logging.basicConfig(level=logging.DEBUG if args.debug else logging.INFO, handlers=[handler])
    logging.getLogger("edgevpr").setLevel(logging.WARNING if args.quiet else logging.NOTSET)
    try:
        return int(args.run(args) or 0)
    except EdgevprError as error:
        return _report_failure(args, error, str(error), error.exit_code)
    except BrokenPipeError:  # the reader of the output has exited (`edgevpr ... | head`)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        prefix = f"{error.filename}: " if error.filename else ""
        sentence = f"{prefix}{error.strerror or error}: check the path, its permissions and the disk."
        return _report_failure(args, error, sentence, 1)
    except ImportError as error:
        return _report_failure(args, error, f"{error}: package missing or broken: reinstall edgevpr on a 64-bit OS.", 1)
    except KeyboardInterrupt:
        print("edgevpr: stopped; what was reported as written is kept.", file=sys.stderr)
        return 130


def _report_failure(args: argparse.Namespace, error: Exception, sentence: str, exit_code: int) -> int:
    if args.debug:
        logging.exception(error)
    print(f"edgevpr: {sanitize(sentence)}", file=sys.stderr)
    return exit_code


@cache  # building it takes two thirds of a short command's time, and one process may run many commands
def make_parser() -> argparse.ArgumentParser:
    """Return the parser of the whole command line."""
    parser = Parser(prog="edgevpr", description="Visual place recognition for the companion computer of a small drone.")
    parser.add_argument("--version", action="version", version=f"edgevpr {__version__}")
    text = "print debug messages, and the traceback of an error"
    parser.add_argument("-v", "--debug", action="store_true", help=text)
    parser.add_argument("-q", "--quiet", action="store_true", help="print warnings only, and no progress")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    for group in _GROUPS:
        group.add(commands)
    return parser
