"""`edgevpr eval`: measure techniques on a data set with ground truth."""

import sys
from argparse import Namespace
from pathlib import Path
from typing import Any

from edgevpr.cli.shared import (
    add_json,
    add_keys,
    add_parameters,
    command,
    config_of,
    parameters_of,
    print_json,
    value_of,
)
from edgevpr.config import FORMS
from edgevpr.errors import ModelError, UsageError
from edgevpr.helpers.text import shown


def add(commands: Any) -> None:
    """Add the command and its flags."""
    parser = command(commands, "eval", evaluate, "measure techniques on a data set with ground truth")
    parser.add_argument("--query", required=True, metavar="DIR")
    parser.add_argument("--ref", required=True, metavar="DIR")
    parser.add_argument("--ground-truth", required=True, metavar="CSV")
    parser.add_argument(
        "--form", default="float", metavar="A,B", help=f"of vectors, one row each: {', '.join(FORMS)} (float)"
    )
    parser.add_argument("--exact", action="store_true", help="compare all places in full, which no flight has time for")
    parser.add_argument("--follow", action="store_true", help="the queries are those of one flight, in order (cohog)")
    parser.add_argument("--config", metavar="FILE", help="YAML; its sections `salience` and `match` count")
    add_keys(parser, "source.camera", "match.candidates", "match.sequence", "salience.use")
    parser.add_argument("--techniques", default="hog,cohog", metavar="A,B", help="names, comma-separated")
    add_parameters(parser, "a parameter of a technique", "TECHNIQUE.KEY=VALUE")
    parser.add_argument("--plot", metavar="FILE", help="draw the precision-recall curves (.png, .pdf, .svg)")
    add_json(parser)


def evaluate(args: Namespace) -> int:
    """Measure techniques, one after another."""
    from edgevpr import techniques
    from edgevpr.evaluate import evaluate as evaluation
    from edgevpr.evaluate.curves import plot
    from edgevpr.evaluate.dataset import load_dataset
    from edgevpr.evaluate.tables import results_text
    from edgevpr.helpers.figures import require_picture
    from edgevpr.helpers.progress import progress
    from edgevpr.runtime.preflight.offers import offers, usable
    from edgevpr.runtime.recognise.opening import gate_of

    wanted = [name.strip() for name in args.techniques.split(",") if name.strip()]
    if not wanted:
        raise UsageError(f"--techniques names none: use some of {', '.join(techniques.names())}.")
    config = config_of(args, args.config)
    match, gate = config.match, gate_of(config.salience)
    if args.plot:
        require_picture(Path(args.plot))
    forms = [form.strip() for form in args.form.split(",")]
    if unknown := [form for form in forms if form not in FORMS]:
        raise UsageError(f"--form names `{unknown[0]}`: use some of {', '.join(FORMS)}.")
    # A wrong setting is reported before the first hour of work; a network that cannot be used stops no other.
    tried = list(usable(offers(wanted, forms, _settings(args, wanted))))
    errors = {offer.label: each for offer, each in tried if isinstance(each, ModelError)}
    if len(errors) == len(tried):
        raise next(iter(errors.values()))
    dataset = load_dataset(args.query, args.ref, args.ground_truth)
    results = [
        evaluation.evaluate(
            offer.name,
            dataset,
            offer.settings,
            match.candidates,
            progress,
            match.sequence,
            gate,
            args.exact,
            args.follow,
        )
        for offer, _ in tried
        if offer.label not in errors
    ]
    results = evaluation.compare(results)
    if args.plot:
        plot({Path(args.ground_truth).resolve().parent.name: results}, Path(args.plot))
    if args.json:
        print_json(evaluation.as_json(results))
    else:
        print(results_text(results))
    for label, error in errors.items():
        print(f"edgevpr: {label} was not measured: {shown(str(error))}", file=sys.stderr)
    return 1 if errors else 0


def _settings(args: Namespace, wanted: list[str]) -> dict[str, dict[str, str]]:
    """Read the settings of each technique. Raises UsageError for one of a technique that is not measured."""
    from edgevpr.runtime.preflight.pick import camera_setting

    settings = {name: camera_setting(name, value_of(args, "source.camera")) for name in wanted}
    for key, value in parameters_of(args.param).items():
        name, _, parameter = key.partition(".")
        if name not in settings or not parameter:
            raise UsageError(f"--param {key}: write TECHNIQUE.KEY=VALUE with a technique of --techniques.")
        settings[name][parameter] = value
    return settings
