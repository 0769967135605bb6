"""The command line: what can be asked. What is done about it is in `commands`, imported only once it is asked for."""

import argparse
import logging
import os
import sys

from edgevpr import __version__
from edgevpr.errors import EdgevprError

_FORMS = ("float", "8bit", "1bit")
_RECORDING = "a folder of images or a video file"
_SOURCE = "a folder of images, a video file, a camera (/dev/video0) or a stream (rtsp://, udp://, tcp://, http://)"


def main(argv: list[str] | None = None) -> int:
    """Run one command; returns the exit code: 0 done, 1 something in the world is wrong, 2 the request is."""
    args = _parser().parse_args(argv)
    # Before NumPy is imported: its products here are small, and more threads make them slower and dearer.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    logging.basicConfig(
        level=logging.DEBUG if args.debug else logging.INFO, format="edgevpr: %(message)s", stream=sys.stderr
    )
    try:
        from edgevpr import commands

        return getattr(commands, args.command)(args)
    except EdgevprError as error:
        return _failed(args, error, str(error), error.exit_code)
    except BrokenPipeError:  # the reader of our output has gone (`edgevpr ... | head`)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        what = f"{error.filename}: " if error.filename else ""
        return _failed(
            args, error, f"{what}{error.strerror or error}: check the path, its permissions and the disk.", 1
        )
    except ImportError as error:
        return _failed(args, error, f"{error}: a package is missing or broken; install edgevpr again (64-bit OS).", 1)
    except KeyboardInterrupt:
        print("edgevpr: stopped; everything confirmed so far is kept.", file=sys.stderr)
        return 130


def _failed(args: argparse.Namespace, error: Exception, sentence: str, exit_code: int) -> int:
    if args.debug:
        logging.exception(error)
    print(f"edgevpr: {sentence}", file=sys.stderr)
    return exit_code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="edgevpr", description="Visual place recognition for the companion computer of a small drone."
    )
    parser.add_argument("--version", action="version", version=f"edgevpr {__version__}")
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")

    map_parser = _add(commands, "map", None, "build, look into, merge and export place maps")
    maps = map_parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    build = _add(maps, "build", "map_build", "make a map of a flight")
    build.add_argument("map", metavar="MAP", help="the map file to make, e.g. valley.gpkg")
    _source(build, required=True)
    build.add_argument("--technique", metavar="NAME", help="see `edgevpr profile` (default: by the board)")
    build.add_argument("--param", action="append", default=[], metavar="KEY=VALUE", help="a parameter of the technique")
    build.add_argument(
        "--board", default="this", metavar="NAME", help="the board that will fly (default: this machine)"
    )
    _camera(build)
    build.add_argument(
        "--rate-hz", type=_positive, metavar="HZ", help="places a second of a video (default: every frame)"
    )
    build.add_argument("--append", action="store_true", help="add to an existing map, going on where it broke off")
    _json(build)
    info = _add(maps, "info", "map_info", "say what a map holds")
    info.add_argument("map", metavar="MAP")
    _json(info)
    merge = _add(maps, "merge", "map_merge", "make one map of several of the same technique")
    merge.add_argument("out", metavar="OUT", help="the map file to make")
    merge.add_argument("maps", metavar="MAP", nargs="+")
    export = _add(maps, "export", "map_export", "write the places for a map viewer")
    export.add_argument("map", metavar="MAP")
    export.add_argument("--geojson", required=True, metavar="FILE", help="GeoJSON file to write, - for standard output")

    match = _add(commands, "match", "match", "find the places of images in a map, offline")
    match.add_argument("map", metavar="MAP")
    _source(match, required=True)
    match.add_argument("--technique", metavar="NAME", help="insist on this technique")
    match.add_argument("--param", action="append", default=[], metavar="KEY=VALUE", help="insist on this parameter")
    _matching(match)
    _json(match)

    run = _add(commands, "run", "run", "recognise places in flight and tell the flight controller")
    run.add_argument("--config", metavar="FILE", help="YAML; flags given here override it")
    run.add_argument("--map", metavar="MAP")
    _source(run, required=False)
    run.add_argument("--technique", metavar="NAME", help="insist on this technique")
    run.add_argument("--rate-hz", type=float, metavar="HZ", help="queries a second (default: the board's)")
    run.add_argument(
        "--reach-m-s", type=float, metavar="V", help="look only where this speed can have led (default: everywhere)"
    )
    run.add_argument("--link", metavar="URL", help="udpout:HOST:PORT, udpin:HOST:PORT, tcp:HOST:PORT, serial:DEV:BAUD")
    run.add_argument("--log", metavar="FILE", help="flight log, JSON lines")
    run.add_argument(
        "--learn",
        action="store_true",
        default=None,
        help="add to the map what it does not know, or make a new one, by the flight controller's position",
    )
    _matching(run)

    check = _add(commands, "check", "check", "say whether a configuration would fly")
    check.add_argument("--config", required=True, metavar="FILE")

    profile = _add(commands, "profile", "profile", "say before take-off what each technique costs in RAM and battery")
    profile.add_argument("--board", default="this", metavar="NAME", help="a board, or `this` (default); see --list")
    profile.add_argument("--list", action="store_true", help="list the boards")
    places = profile.add_mutually_exclusive_group()
    places.add_argument("--map", metavar="MAP", help="the map to fly with")
    places.add_argument("--places", type=int, metavar="N", help="the number of places to fly with")
    profile.add_argument("--rate-hz", type=float, metavar="HZ", help="queries a second (default: the board's)")
    profile.add_argument("--flight-min", type=float, default=20.0, metavar="MIN", help="length of the flight (20)")
    profile.add_argument("--battery", default=None, metavar="PACK", help="cells and capacity, e.g. 4S5200")
    profile.add_argument("--budget-mb", type=float, metavar="MB", help="limit of the index in RAM")
    profile.add_argument("--hover-w", type=float, metavar="W", help="what the aircraft draws to hover: minutes lost")
    profile.add_argument(
        "--plot", metavar="FILE", help="draw RAM against charge, and the map's memory (.png, .pdf, .svg)"
    )
    own = profile.add_mutually_exclusive_group()
    own.add_argument("--detect", action="store_true", help="say which board this is, and why; --out writes a profile")
    own.add_argument(
        "--measure",
        action="store_true",
        help="measure every technique here, and the power if there is a meter; keep it",
    )
    profile.add_argument("--images", metavar="DIR", help="pictures to measure on (default: generated ones)")
    profile.add_argument("--out", metavar="FILE", help="where --detect (.yaml) or --measure (.json) write to")
    _json(profile)

    evaluate = _add(commands, "eval", "evaluate", "measure techniques on a data set with ground truth")
    evaluate.add_argument("--query", required=True, metavar="DIR")
    evaluate.add_argument("--ref", required=True, metavar="DIR")
    evaluate.add_argument("--ground-truth", required=True, metavar="CSV")
    _camera(evaluate)
    evaluate.add_argument(
        "--form", default="float", metavar="A,B", help=f"of vectors, one row each: {', '.join(_FORMS)} (float)"
    )
    evaluate.add_argument("--candidates", type=int, metavar="N", help="places compared in full (default: all, exact)")
    _sequence(evaluate)
    evaluate.add_argument("--techniques", default="hog,cohog", metavar="A,B", help="names, comma-separated")
    evaluate.add_argument(
        "--param", action="append", default=[], metavar="TECHNIQUE.KEY=VALUE", help="a parameter of a technique"
    )
    evaluate.add_argument("--plot", metavar="FILE", help="draw the precision-recall curves (.png, .pdf, .svg)")
    _json(evaluate)

    simulate = _add(commands, "simulate", None, "a generated flight, a flight controller to talk to")
    simulations = simulate.add_subparsers(title="commands", required=True, metavar="COMMAND")
    autopilot = _add(simulations, "autopilot", "simulate_autopilot", "a flight controller that answers and counts")
    autopilot.add_argument("--link", default="udpin:127.0.0.1:14550", metavar="URL", help="(udpin:127.0.0.1:14550)")
    autopilot.add_argument("--duration-s", type=float, metavar="S", help="how long (default: until stopped)")
    autopilot.add_argument(
        "--track", metavar="CSV", help="a positions.csv with times to fly along, from when a companion is first heard"
    )
    _json(autopilot)
    flight = _add(simulations, "flight", "simulate_flight", "write a generated flight: images and positions.csv")
    flight.add_argument("out", metavar="DIR")
    flight.add_argument("--which", choices=("map", "query"), default="map", help="the mapping flight, or a later one")
    flight.add_argument("--seed", type=int, default=1, metavar="N", help="another seed, another landscape (1)")

    train = _add(commands, "train", None, "train a network on your own pictures (needs edgevpr[train])")
    trainings = train.add_subparsers(title="commands", required=True, metavar="COMMAND")
    train_calc = _add(trainings, "calc", "train_calc", "train the CALC autoencoder; no labels are needed")
    _training_images(train_calc)
    train_calc.add_argument("--out", required=True, metavar="FILE.onnx", help="the model to make; its card lies beside")
    train_calc.add_argument("--steps", type=int, default=4000, metavar="N", help="batches of 32 pictures (4000)")
    train_calc.add_argument("--seed", type=int, default=1, metavar="N", help="(1)")
    train_calc.add_argument("--resume", action="store_true", help="go on with a training that was stopped")
    _json(train_calc)
    train_words = _add(trainings, "words", "train_words", "learn the words that vlad, regions or bow count")
    _training_images(train_words)
    train_words.add_argument("--model", default="calc", metavar="NAME", help="the card of the backbone (calc)")
    train_words.add_argument("--kind", required=True, choices=("vlad", "regions", "bow"), help="what the words are of")
    train_words.add_argument("--count", type=int, required=True, metavar="N", help="the number of words")
    train_words.add_argument("--whiten", type=int, metavar="D", help="also learn a whitening to D values (vlad)")
    train_words.add_argument("--out", metavar="DIR", help="folder to write to (default: your models folder)")
    train_words.add_argument("--seed", type=int, default=1, metavar="N", help="(1)")
    _json(train_words)

    models_parser = _add(commands, "models", None, "list, try and add the networks that techniques use")
    models = models_parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    _json(_add(models, "list", "models_list", "say which networks there are, whose weights, and what uses them"))
    verify = _add(models, "verify", "models_verify", "run networks here: do they work, and what do they take")
    verify.add_argument("name", metavar="NAME", nargs="?", help="a network (default: all)")
    _json(verify)
    add = _add(models, "add", "models_add", "try a network, and copy it and its card to your models folder")
    add.add_argument("file", metavar="FILE.onnx")
    add.add_argument("--card", required=True, metavar="CARD.yaml", help="its name is that of the network")
    _json(add)
    quantise = _add(models, "quantise", "models_quantise", "make NAME_int8 of a network (needs edgevpr[train])")
    quantise.add_argument("name", metavar="NAME")
    quantise.add_argument("--calibrate", required=True, metavar="DIR", help="images like those of the flight")
    quantise.add_argument("--query", metavar="DIR", help="with --ref and --ground-truth: recall before and after")
    quantise.add_argument("--ref", metavar="DIR")
    quantise.add_argument("--ground-truth", metavar="CSV")
    _json(quantise)

    demo = _add(commands, "demo", "demo", "the whole job on a generated flight, with a picture")
    demo.add_argument("--out", default="demo_out", metavar="DIR", help="(demo_out)")

    service = _add(commands, "service", "service", "print the systemd unit for a board")
    service.add_argument("--board", default="this", metavar="NAME")
    service.add_argument("--config", default="/etc/edgevpr/config.yaml", metavar="FILE")
    return parser


def _add(commands, name: str, command: str | None, text: str) -> argparse.ArgumentParser:
    parser = commands.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
    # Also after the command, where everybody types it.
    parser.add_argument("--debug", action="store_true", default=argparse.SUPPRESS, help=argparse.SUPPRESS)
    if command:
        parser.set_defaults(command=command)
    return parser


def _source(parser: argparse.ArgumentParser, required: bool) -> None:
    parser.add_argument(
        "--images",
        "--source",
        dest="source",
        required=required,
        metavar="SOURCE",
        help=_RECORDING if required else _SOURCE,
    )
    parser.add_argument(
        "--positions", metavar="CSV", help="file,lat,lon[,alt,yaw_deg,time] (default: beside the images)"
    )


def _training_images(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--images", required=True, nargs="+", metavar="DIR", help="folders of images")


def _camera(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--camera",
        choices=("nadir", "forward"),
        help="straight down, or ahead (default: the map's; a new map's is forward)",
    )


def _matching(parser: argparse.ArgumentParser) -> None:
    _camera(parser)
    parser.add_argument("--matching", choices=("displacement", "thesis"), help="how cohog scores (displacement)")
    parser.add_argument(
        "--form", choices=_FORMS, help="what a number of a vector takes in RAM: half precision, a byte or a bit (float)"
    )
    parser.add_argument("--board", metavar="NAME", help="hardware profile (default: this machine)")
    parser.add_argument(
        "--budget-mb", type=float, metavar="MB", help="limit of the index in RAM (default: the board's)"
    )
    parser.add_argument("--candidates", type=int, metavar="N", help="places compared in full (the technique's)")
    _sequence(parser)
    parser.add_argument("--min-score", type=float, metavar="S", help="accept from this score on")
    parser.add_argument("--min-margin", type=float, metavar="M", help="accept when this far ahead of a place elsewhere")
    parser.add_argument("--battery", metavar="PACK", help="cells and capacity of the pack, e.g. 4S5200")


def _sequence(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--sequence", type=int, metavar="N", help="queries matched together (the technique's)")


def _positive(text: str) -> float:
    value = float(text)
    if not 0 < value < float("inf"):
        raise ValueError
    return value


def _json(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print JSON")
