"""`edgevpr eval`: measure techniques, or stored similarities, on data sets with ground truth.

Here a set is a data set, and a row is a technique with its settings, which has one row in the printed tables.
"""

import os
import tempfile
from argparse import Namespace
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgevpr.cli.shared import (
    add_json,
    add_keys,
    add_known,
    add_parameters,
    command,
    count,
    load_command_config,
    parse_parameters,
    parse_value,
    positive,
    report,
    show,
)
from edgevpr.core.config import FORMS
from edgevpr.core.errors import ModelError, UsageError
from edgevpr.core.text import progress, shown

if TYPE_CHECKING:
    from collections.abc import Sequence

    from edgevpr.lab.evaluate.metrics import Quality, TechniqueResult
    from edgevpr.lab.evaluate.plan import EvaluationPlan, RowPlan


def add(commands: Any) -> None:
    """Add the command and its flags."""
    parser = command(commands, "eval", evaluate, "evaluate techniques on a data set with ground truth")
    parser.add_argument("--data", nargs="+", metavar="FOLDER", help="data set in any known layout; several need --out")
    parser.add_argument("--sets", metavar="FILE", help="YAML file of many data sets and settings; needs --out")
    parser.add_argument(
        "--out", metavar="FOLDER", help="folder for results.json and a page; an interrupted run resumes"
    )
    parser.add_argument(
        "--workers", type=count, metavar="N", help="number of processes, with --out (default: all cores)"
    )
    video = "folder of query images, or a video with its positions beside it (FLIGHT.mp4 and .csv: time,lat,lon[,...])"
    parser.add_argument("--query", metavar="SOURCE", help=video)
    parser.add_argument("--ref", metavar="SOURCE", help="folder of reference images, or a video with its positions")
    parser.add_argument(
        "--rate-hz", type=positive, metavar="HZ", help="images per second of a video (default: every frame)"
    )
    parser.add_argument("--ground-truth", metavar="FILE", help="CSV: query_file,ref_files (else: what is near)")
    parser.add_argument(
        "--within-m",
        type=positive,
        default=25.0,
        metavar="M",
        help="distance in metres that counts as near (default: 25)",
    )
    parser.add_argument(
        "--within-deg",
        type=positive,
        metavar="DEG",
        help="maximum difference of headings that counts as near, in degrees",
    )
    parser.add_argument("--similarity", nargs="+", metavar="FILE", help="evaluate stored similarity matrices (.npy)")
    parser.add_argument("--form", default="float", metavar="A,B", help=f"of vectors: {', '.join(FORMS)} (float)")
    parser.add_argument("--exact", action="store_true", help="compare all places in full; too slow for a flight")
    parser.add_argument("--follow", action="store_true", help="treat the queries as one flight, in order (cohog only)")
    add_known(parser)
    parser.add_argument(
        "--config", metavar="FILE", help="configuration file; its sections `salience` and `match` are used"
    )
    add_keys(parser, "source.camera", "match.candidates", "match.sequence", "salience.use")
    parser.add_argument(
        "--techniques", default="hog,cohog", metavar="A,B", help="techniques to evaluate, separated by commas"
    )
    add_parameters(parser, "a parameter of a technique", "TECHNIQUE.KEY=VALUE")
    add_json(parser)


def evaluate(args: Namespace) -> int:
    """Run `eval`: measure stored similarities, many rows on many sets (with --out), or rows on one set."""
    if args.similarity:
        return _measure_similarities(args)
    return _measure_many(args) if args.out else _measure_techniques(args)


def _measure_many(args: Namespace) -> int:
    """Measure many rows on many sets, and write the results to --out. Rows that an earlier run measured are reused."""
    from edgevpr.lab.evaluate.many import measure
    from edgevpr.lab.evaluate.page import as_json, write_results
    from edgevpr.lab.evaluate.tables import results_text

    if parse_value(args, "salience.use"):
        raise UsageError("--salience goes without --out: it takes one set.")
    plan = _plan(args)
    _say_cameras(plan)
    out = Path(args.out)
    out.mkdir(parents=True, exist_ok=True)
    outcome = measure(plan, out, args.workers or len(os.sched_getaffinity(0)), progress)
    write_results(out, outcome)
    measured = [(name, [row.result for row in rows]) for name, rows in outcome.found.items()]
    tables = [f"{shown(name)}\n\n{results_text(results)}\n" for name, results in measured if results]
    show(as_json(outcome), args.json, "\n".join([*tables, f"{out / 'index.html'}: look at it."]))
    report(*(f"{name}, {row} was not measured: {why}" for (name, row), why in outcome.failed.items()))
    return 1 if outcome.failed else 0


def _measure_techniques(args: Namespace) -> int:
    """Measure techniques on one set, and print the results."""
    from edgevpr.lab.evaluate.evaluate import evaluate
    from edgevpr.lab.evaluate.metrics import compare
    from edgevpr.runtime.recognise.opening import open_salience_gate

    if args.sets or args.workers or len(args.data or ()) > 1:
        raise UsageError("--sets, --workers and several sets need a folder for the results: name it with --out.")
    plan = _plan(args)
    gate = open_salience_gate(load_command_config(args, args.config).salience)
    (chosen,) = plan.sets.values()
    measured: list[TechniqueResult] = []
    errors: dict[str, ModelError] = {}  # by technique, whatever the form
    with tempfile.TemporaryDirectory(prefix="edgevpr-eval-") as videos:
        dataset = chosen.open(Path(videos), progress)
        _say_cameras(plan)
        for row in plan.rows.values():
            try:
                measured.append(evaluate(row.technique, dataset, row.settings(None), row, progress, gate))
            except ModelError as error:  # the other techniques are still measured
                errors[row.technique] = error
    if not measured:
        raise next(iter(errors.values()))
    _show("techniques", compare(measured), args.json)
    report(*(f"{technique} was not measured: {error}" for technique, error in errors.items()))
    return 1 if errors else 0


def _measure_similarities(args: Namespace) -> int:
    from edgevpr.lab.evaluate.dataset import list_names, read_truth
    from edgevpr.lab.evaluate.similarity import add_unscored, measure, read_similarities

    if not args.ground_truth:
        raise UsageError("Name the ground truth of the stored similarities with --ground-truth.")
    truth = read_truth(args.ground_truth)
    if args.query:
        truth = add_unscored(truth, list_names(args.query))
    references = list_names(args.ref) if args.ref else None
    results = [measure(Path(file).stem, read_similarities(file), truth, references) for file in args.similarity]
    _show("similarities", results, args.json)
    return 0


def _show(what: str, results: "Sequence[Quality]", as_json: bool) -> None:
    from edgevpr.lab.evaluate.tables import results_text

    show({what: {result.technique: asdict(result) for result in results}}, as_json, results_text(results))


def _plan(args: Namespace) -> "EvaluationPlan":
    """Return the plan of sets and rows, from the file --sets or from the other flags."""
    from edgevpr.lab.evaluate.plan import EvaluationPlan, SetPlan, read_plan

    if args.sets:
        if args.data or args.query or args.ref or args.rate_hz:
            raise UsageError("--sets names all sets: leave --data, --query, --ref and --rate-hz out.")
        if args.known:
            raise UsageError("--sets has `known: heading,height` in its rows: leave --known out.")
        return read_plan(args.sets)
    if not (args.data or (args.query and args.ref)):
        raise UsageError(
            "Name the data sets with --data or --query and --ref, or a file of sets and rows with --sets; or stored "
            "similarities with --similarity."
        )
    if args.data and args.ground_truth:
        raise UsageError("--ground-truth goes with --query and --ref: a folder of --data has its own.")
    common = {"within_m": args.within_m, "within_deg": args.within_deg, "rate_hz": args.rate_hz}
    sets = {}
    if args.query and args.ref:
        query, ref = (Path(side).resolve() for side in (args.query, args.ref))
        sets[f"{query.name} on {ref.name}"] = SetPlan(
            query=str(query), ref=str(ref), ground_truth=args.ground_truth, **common
        )
    for folder in args.data or ():
        path = Path(folder).resolve()
        sets[path.name if path.name not in sets else str(path)] = SetPlan(folder=str(path), **common)
    return EvaluationPlan(sets, _rows(args))


def _rows(args: Namespace) -> "dict[str, RowPlan]":
    """Return the rows that the flags ask for, by name: each technique in each form. Raises UsageError for an unknown
    form, or a --param of a technique that is not in --techniques."""
    from edgevpr import techniques
    from edgevpr.lab.evaluate.plan import RowPlan
    from edgevpr.runtime.preflight.pick import camera_setting
    from edgevpr.runtime.preflight.trial import offers

    wanted = [name.strip() for name in args.techniques.split(",") if name.strip()]
    if not wanted:
        raise UsageError(f"--techniques names none: use some of {', '.join(techniques.names())}.")
    forms = [form.strip() for form in args.form.split(",")]
    if unknown := [form for form in forms if form not in FORMS]:
        raise UsageError(f"--form names `{unknown[0]}`: use some of {', '.join(FORMS)}.")
    settings = {name: camera_setting(name, parse_value(args, "source.camera")) for name in wanted}
    for key, value in parse_parameters(args.param).items():
        name, _, parameter = key.partition(".")
        if name not in settings or not parameter:
            raise UsageError(f"--param {key}: write TECHNIQUE.KEY=VALUE with a technique of --techniques.")
        settings[name][parameter] = value
    match = load_command_config(args, args.config).match
    return {
        offer.label: RowPlan(
            technique=offer.name,
            parameters={key: value for key, value in offer.settings.items() if key != "form"},
            form=offer.settings.get("form"),
            candidates=match.candidates,
            sequence=match.sequence,
            exact=args.exact,
            follow=args.follow,
            known=args.known,
        )
        for offer in offers(wanted, forms, settings)
    }


def _say_cameras(plan: "EvaluationPlan") -> None:
    """Print a note for each set whose camera is assumed to look ahead because no flag or file says where it looks."""
    from edgevpr import techniques

    for name, of in plan.sets.items():
        rows = ((techniques.parameters(row.technique), row.settings(of.camera)) for row in plan.rows.values())
        if any("camera" in known and "camera" not in settings for known, settings in rows):
            report(
                f"{name} is taken to look ahead: where its camera looks straight down, say `--camera nadir` "
                "(`camera: nadir` in a file of sets)"
            )
