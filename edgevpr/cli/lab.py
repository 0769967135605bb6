"""Commands for researchers: `edgevpr eval` measures techniques on data sets with ground truth, `edgevpr simulate`
writes the images of a simulated flight, and `edgevpr demo` shows all steps from map to match.

In the code of `eval`, a set is a data set, and a row of the printed tables is one technique with its settings."""

from argparse import ArgumentParser, ArgumentTypeError, Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgevpr.cli import shared
from edgevpr.core.config import FORMS
from edgevpr.core.errors import UsageError
from edgevpr.core.text import progress, sanitize

if TYPE_CHECKING:
    from edgevpr.lab.evaluate.dataset import Dataset

# Number flags of a flight over an orthophoto: (default, minimum, maximum, help text).
_NUMBER_FLAGS: dict[str, tuple[float | None, float, float, str]] = {
    "height_m": (None, 1.0, 10_000.0, "height above ground in metres (default: that of the track)"),
    "every_m": (20.0, 1.0, 1e6, "distance between images of a mission in metres (default: 20)"),
    "fov_deg": (66.0, 5.0, 120.0, "field of view across the image in degrees (default: 66)"),
}


def add(commands: Any) -> None:
    """Add the commands and their flags."""
    _add_eval(shared.add_command(commands, "eval", run_eval, "evaluate techniques on data sets with ground truth"))
    simulations = shared.add_group(commands, "simulate", "generate the images of flights")
    text = "generate the images and positions.csv of a flight"
    flight = shared.add_command(simulations, "flight", run_simulate_flight, text)
    flight.add_argument("out", metavar="DIR")
    flight.add_argument("--which", choices=("map", "query"), help="map (default): mapping flight; query: later flight")
    text = "random seed for the landscape and motion (default: 1)"
    flight.add_argument("--seed", type=_parse_seed, default=1, metavar="N", help=text)
    orthophoto = flight.add_argument_group("over an orthophoto")
    orthophoto.add_argument("--orthophoto", metavar="FILE", help="orthophoto, as for `map build` (needs rasterio)")
    text = "mission, or positions.csv with height_m[, yaw_deg, roll_deg, pitch_deg]"
    orthophoto.add_argument("--track", metavar="FILE", help=text)
    for name, (*_, text) in _NUMBER_FLAGS.items():
        orthophoto.add_argument(f"--{name.replace('_', '-')}", type=float, metavar="X", help=text)
    demo = shared.add_command(commands, "demo", run_demo, "map a generated flight, match a later one, and draw results")
    demo.add_argument("--out", default="demo_out", metavar="DIR", help="folder to write (default: demo_out)")


def _add_eval(parser: ArgumentParser) -> None:
    parser.add_argument("--data", nargs="+", default=[], metavar="FOLDER", help="data sets in any supported layout")
    parser.add_argument("--query", metavar="FOLDER", help="folder of query images")
    parser.add_argument("--ref", metavar="FOLDER", help="folder of reference images")
    parser.add_argument("--ground-truth", metavar="FILE", help="CSV: query_file,ref_files (default: see --within-m)")
    text = "references within this distance of a query, in metres, are correct (default: 25)"
    parser.add_argument("--within-m", type=shared.parse_positive, default=25.0, metavar="M", help=text)
    text = f"vector formats to evaluate: {', '.join(FORMS)} (default: float)"
    parser.add_argument("--form", default="float", metavar="A,B", help=text)
    parser.add_argument("--exact", action="store_true", help="compare all places in full; too slow for a flight")
    parser.add_argument("--follow", action="store_true", help="treat the queries as one flight, in order (cohog only)")
    shared.add_known(parser)
    text = "configuration file; its sections `salience` and `match` are used"
    parser.add_argument("--config", metavar="FILE", help=text)
    shared.add_keys(parser, "source.camera", "match.candidates", "match.sequence", "salience.use")
    text = "techniques to evaluate (default: hog,cohog)"
    parser.add_argument("--techniques", default="hog,cohog", metavar="A,B", help=text)
    shared.add_parameters(parser, "set a parameter of a technique", "TECHNIQUE.KEY=VALUE")
    shared.add_json(parser)


def run_eval(args: Namespace) -> int:
    """Run `eval`: measure techniques on data sets, and print the results."""
    from edgevpr.lab.evaluate.evaluate import MatchOptions, measure
    from edgevpr.lab.evaluate.tables import format_results

    config, rows, sets = shared.make_config(args, args.config), _list_rows(args), _open_sets(args)
    match = config.match
    options = MatchOptions(
        candidates=match.candidates, sequence=match.sequence, exact=args.exact, follow=args.follow, known=args.known
    )
    outcome = measure(sets, rows, options, config.salience, progress)
    content = outcome.as_json()
    if not content["results"]:
        raise next(iter(outcome.failed.values()))
    if len(sets) == 1:
        content["techniques"] = {row["row"]: row for row in content.pop("results")}
    measured = ((sanitize(name), results) for name, results in outcome.measured.items() if results)
    tables = [f"{name}\n\n{format_results(results)}\n" for name, results in measured]
    shared.print_result(content, args.json, "\n".join(tables))
    shared.print_notes(*(f"{row} not evaluated on {name}: {error}" for (name, row), error in outcome.failed.items()))
    return 1 if outcome.failed else 0


def _open_sets(args: Namespace) -> "dict[str, Dataset]":
    """Open the data sets given by the flags."""
    from edgevpr.lab.evaluate.dataset import load_dataset, match_positions, open_folder

    if not (args.data or (args.query and args.ref)):
        raise UsageError("Pass data sets with --data, or with --query and --ref.")
    if args.data and args.ground_truth:
        raise UsageError("--ground-truth applies only to --query and --ref: a folder of --data has its own.")
    sets = {}
    if args.query and args.ref:
        query, ref = (Path(folder).resolve() for folder in (args.query, args.ref))
        truth = args.ground_truth
        dataset = load_dataset(query, ref, truth) if truth else match_positions(query, ref, args.within_m)
        sets[f"{query.name} on {ref.name}"] = dataset
    for folder in args.data:
        path = Path(folder).resolve()
        sets[path.name if path.name not in sets else str(path)] = open_folder(path, args.within_m)
    return sets


def _list_rows(args: Namespace) -> dict[str, tuple[str, dict[str, Any]]]:
    """Return the rows requested by the flags, for `measure`: each technique in each form. Raises UsageError for an
    unknown form, and for a --param of a technique that is not in --techniques."""
    from edgevpr import techniques
    from edgevpr.runtime.preflight.pick import make_camera_setting
    from edgevpr.runtime.preflight.trial import list_trials

    names = [name.strip() for name in args.techniques.split(",") if name.strip()]
    if not names:
        raise UsageError(f"--techniques is empty: choose from {', '.join(techniques.list_techniques())}.")
    forms = [form.strip() for form in args.form.split(",")]
    if unknown := [form for form in forms if form not in FORMS]:
        raise UsageError(f"--form has an unknown value `{unknown[0]}`: choose from {', '.join(FORMS)}.")
    camera = shared.make_config(args).source.camera
    settings = {name: make_camera_setting(name, camera) for name in names}
    for key, value in shared.parse_parameters(args.param).items():
        name, _, parameter = key.partition(".")
        if name not in settings or not parameter:
            raise UsageError(f"--param {key} must be TECHNIQUE.KEY=VALUE, with a technique from --techniques.")
        settings[name][parameter] = value
    if any("camera" in techniques.read_parameters(name) and "camera" not in settings[name] for name in names):
        shared.print_notes("assuming that the camera faces ahead: pass `--camera nadir` if it faces straight down")
    return {trial.label: (trial.name, trial.settings) for trial in list_trials(settings, forms)}


def _parse_seed(text: str) -> int:
    if not text.isdecimal():
        raise ArgumentTypeError(f"`{text}` is not a whole number of 0 or more")
    return int(text)


def run_simulate_flight(args: Namespace) -> None:
    """Run `simulate flight`: write images and positions.csv of a flight over generated ground or an orthophoto."""
    if args.orthophoto is None:
        if flags := [name for name in ("track", *_NUMBER_FLAGS) if getattr(args, name) is not None]:
            raise UsageError(f"--{flags[0].replace('_', '-')} applies only to --orthophoto: leave it out.")
        from edgevpr.lab.simulate.generated import write_generated_flight

        print(write_generated_flight(Path(args.out), args.which or "map", args.seed))
        return
    if args.track is None or args.which is not None:
        raise UsageError("A flight over an orthophoto needs --track and does not accept --which.")
    from edgevpr.lab.simulate.overflight import read_shots, write_overflight
    from edgevpr.mapmaking.orthophoto import Orthophoto  # loads GDAL, or raises if it is missing

    numbers: dict[str, Any] = {}
    for name, (default, low, high, _) in _NUMBER_FLAGS.items():
        numbers[name] = value = default if getattr(args, name) is None else getattr(args, name)
        if value is not None and not low <= value <= high:  # false for NaN
            raise UsageError(f"--{name.replace('_', '-')} is {value:g}, but must be between {low:g} and {high:g}.")
    shots = read_shots(args.track, numbers["height_m"], numbers["every_m"])
    image_names = write_overflight(Path(args.out), Orthophoto(args.orthophoto), shots, numbers["fov_deg"], args.seed)
    if not (written := sum(1 for _ in progress(image_names, len(shots), "flying"))):
        raise UsageError(f"{args.orthophoto} covers no complete image along {args.track}: no images were written.")
    print(f"{args.out}: {written} images in images/, their positions in positions.csv")
    if beyond := len(shots) - written:
        print(f"{beyond} images left out: they would show ground beyond the orthophoto")


def run_demo(args: Namespace) -> None:
    """Run `demo`: run the demonstration, and print its summary."""
    from edgevpr.lab.simulate import demo

    print(demo.run_demo(Path(args.out)))
