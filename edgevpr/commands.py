"""What each command does: thin functions of the parsed arguments that return an exit code.

Each imports what it needs when it is called, so that `edgevpr check` does not pay for what `edgevpr demo` uses.
"""

import json
import logging
import os
import sys
import threading
from argparse import Namespace
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from edgevpr.config import Config, load_config
from edgevpr.errors import EdgevprError, ImageError, ModelError, UsageError

if TYPE_CHECKING:
    from edgevpr.frames.source import Source
    from edgevpr.power.boards import Board
    from edgevpr.runtime.preflight.estimate import FlightPlan
    from edgevpr.runtime.preflight.networks import Verified
    from edgevpr.runtime.preflight.offers import Offer
    from edgevpr.types import Frame

_log = logging.getLogger(__name__)
_READ_TIMEOUT_S = 1.0


def map_build(args: Namespace) -> int:
    from edgevpr.frames.source import open_source
    from edgevpr.places.mapfile import PlaceMap
    from edgevpr.power.boards import load_board
    from edgevpr.runtime.recognise.mapping import build_map
    from edgevpr.runtime.recognise.pipeline import made_for, picked_technique, technique_of

    step_s = 1 / args.rate_hz if args.rate_hz else None
    source = open_source(args.source, step_s=step_s, positions=_path(args.positions), live=False)
    settings = _settings(args.param)
    if args.camera:
        settings["camera"] = args.camera
    if args.append and Path(args.map).exists():
        place_map = PlaceMap.open_for_adding(args.map)
        technique = technique_of(place_map, args.technique, settings, load_board("this"))
    else:
        name = args.technique or picked_technique(args.board, source.total or 1)
        technique = made_for(load_board("this"), name, settings)
        place_map = PlaceMap.create(args.map, technique.spec)
    unusable: list[ImageError] = []
    with place_map:
        frames = _frames(source, "mapping", unusable)
        result = build_map(frames, technique, place_map, lambda error: _left_out(error, unusable))
        places = len(place_map)
    if args.json:
        _print_json({"map": args.map, "technique": technique.spec.name, "places": places, **asdict(result)})
    else:
        print(
            f"{args.map}: {result.added} places added ({result.without_position} without a position), {places} in all"
        )
        if result.already_here:
            print(f"  {result.already_here} images were in the map already")
    return _said(unusable)


def map_info(args: Namespace) -> int:
    from edgevpr.places.index import bytes_per_place
    from edgevpr.places.mapfile import PlaceMap

    with PlaceMap.open(args.map) as place_map:
        info = place_map.info()
    spec = info.spec
    ram_mb = info.places * bytes_per_place(spec) / 1e6
    if args.json:
        _print_json({**asdict(info), "bytes_per_place": bytes_per_place(spec), "ram_mb": ram_mb})
        return 0
    settings = ", ".join(f"{key} {value}" for key, value in spec.parameters.items())
    print(f"{info.path}: {info.places} places, {info.with_position} with a position")
    print(f"  technique   {spec.name} ({settings})" + (f", model {spec.model_sha256}" if spec.model_sha256 else ""))
    if info.extent:
        south, west, north, east = info.extent
        print(f"  extent      {south:.6f}..{north:.6f} north, {west:.6f}..{east:.6f} east")
    if info.first_time:
        print(f"  time        {info.first_time} to {info.last_time}")
    if info.mean_quality is not None:
        print(f"  quality     {info.mean_quality:.2f} on average (share of the image that says anything)")
    print(f"  size        {info.file_bytes / 1e6:.1f} MB on disk, {ram_mb:.2f} MB in RAM ({info.made_by})")
    return 0


def map_merge(args: Namespace) -> int:
    from edgevpr.places.mapfile import PlaceMap
    from edgevpr.runtime.recognise.pipeline import technique_of

    inputs = [PlaceMap.open(path) for path in args.maps]
    technique_of(inputs[0])
    for other in inputs[1:]:
        other.require(inputs[0].spec)
    with PlaceMap.create(args.out, inputs[0].spec) as merged:
        try:
            for path, place_map in zip(args.maps, inputs, strict=True):
                copied, already_here = merged.absorb(place_map)
                print(f"{path}: {copied} places copied" + (f", {already_here} there already" if already_here else ""))
                place_map.close()
        except EdgevprError:
            Path(args.out).unlink()  # half a merge would look like a whole one
            raise
        print(f"{args.out}: {len(merged)} places")
    return 0


def map_export(args: Namespace) -> int:
    from edgevpr.helpers.files import require_folder, write_whole
    from edgevpr.places.geojson import write_geojson
    from edgevpr.places.mapfile import PlaceMap

    with PlaceMap.open(args.map) as place_map:
        if args.geojson == "-":
            write_geojson(place_map, sys.stdout)
            return 0
        out_path = Path(args.geojson)
        if out_path.exists() and out_path.samefile(args.map):
            raise UsageError(f"--geojson {out_path} is the map itself: give another name.")
        require_folder(out_path)

        def write(unfinished: Path) -> int:
            with open(unfinished, "w", encoding="utf-8") as out:
                return write_geojson(place_map, out)

        count = write_whole(out_path, write)
    print(f"{out_path}: {count} places")
    return 0


def match(args: Namespace) -> int:
    from edgevpr.frames.source import open_source
    from edgevpr.geodesy import distance_m
    from edgevpr.runtime.recognise.pipeline import open_pipeline
    from edgevpr.runtime.recognise.record import record
    from edgevpr.techniques.networks.card import weights_of

    pipeline = open_pipeline(_config(args, map=args.map), _settings(args.param))
    found = []
    unusable: list[ImageError] = []
    source = open_source(args.source, positions=_path(args.positions), live=False)
    for frame in _frames(source, "matching", unusable):
        try:
            fields = record(pipeline.step(frame))
        except ModelError as error:
            _left_out(ImageError(f"{frame.name}: {error}"), unusable)
            continue
        here, there = frame.position, fields["position"]
        if here and there:
            away_m = distance_m(here.lat_deg, here.lon_deg, there["lat_deg"], there["lon_deg"])
            fields["error_m"] = round(float(away_m), 2)
        found.append(fields)
    if args.json:
        _print_json(found)
    else:
        print(f"{'query':<28} {'place':>6} {'reference image':<28} {'score':>6}  accepted  error m")
        for each in found:
            error = f"{each['error_m']:8.1f}" if "error_m" in each else "       -"
            yes = "yes" if each["accepted"] else "no"
            print(
                f"{each['query']:<28} {each['place']:>6} {each['reference_image']:<28} {each['score']:6.3f}  {yes:<8}"
                f" {error}"
            )
        print(f"{len(found)} queries, {sum(each['accepted'] for each in found)} accepted")
        if weights := weights_of(pipeline.technique.spec):
            print(f"Weights of {weights}.")
    return _said(unusable)


def run(args: Namespace) -> int:
    from edgevpr.runtime.service.fly import fly

    code = fly(_config(args, map=args.map), _path(args.positions))
    if threading.active_count() > 1:
        # A capture thread hangs in a stream that does not answer; FFmpeg would abort the end of the interpreter.
        sys.stderr.flush()
        os._exit(code)
    return code


def check(args: Namespace) -> int:
    from edgevpr.runtime.service.check import check as findings_of

    findings = findings_of(args.config)
    for finding in findings:
        print(f"{'ok   ' if finding.ok else 'WRONG'}  {finding.what:<14} {finding.message}")
    return 0 if all(finding.ok for finding in findings) else 1


def profile(args: Namespace) -> int:
    from edgevpr.helpers.figures import require_picture
    from edgevpr.helpers.progress import progress
    from edgevpr.power.boards import board_names, load_board
    from edgevpr.runtime.preflight.choose import require_technique
    from edgevpr.runtime.preflight.estimate import estimate
    from edgevpr.runtime.preflight.estimate_text import format_table
    from edgevpr.runtime.preflight.stored import default_path, known_and_tried, load, scaled_from

    if args.list:
        for name in board_names():
            print(f"{name:<20} {load_board(name).title}")
        return 0
    if args.out and not (args.detect or args.measure):
        raise UsageError("--out is for --detect and --measure: name one of them too.")
    if args.images and not args.measure:
        raise UsageError("--images is for --measure: give both.")
    asked = args.map is not None or args.places is not None
    if args.detect:
        if asked or args.plot:
            raise UsageError("--detect says what this machine is: ask what a flight costs without it.")
        return _profile_detect(args)
    if not asked and (args.plot or not args.measure):
        raise UsageError("Say how many places will be flown with: --map MAP, or --places N.")
    if args.plot:
        require_picture(Path(args.plot))
    board = load_board(args.board)
    require_technique(board)
    plan, map_technique, wanted = _plan(args, board) if asked else (None, None, ())
    code = _profile_measure(args, quiet=asked) if args.measure else 0
    if plan is None:
        return code
    stored, refused = load(Path(args.out) if args.measure and args.out else default_path())
    if refused:
        print(f"edgevpr: {refused}", file=sys.stderr)
    trials = progress(known_and_tried(wanted, board, stored), len(wanted), "trying techniques")
    here = scaled_from(load_board("this"), board, stored)
    result = estimate(board, here, trials, plan, map_technique, stored.date if stored else None)
    if args.plot:
        from edgevpr.runtime.preflight.chart import plot

        plot(result, board, Path(args.plot))
    if args.json:
        _print_json(asdict(result))
    else:
        print(format_table(result))
    return code


def _plan(args: Namespace, board: "Board") -> "tuple[FlightPlan, str | None, tuple[Offer, ...]]":
    """What is asked of `profile`, the technique of the map if there is one, and what is to be tried."""
    from edgevpr import techniques
    from edgevpr.config import load_config
    from edgevpr.places.mapfile import PlaceMap
    from edgevpr.power.equations import parse_pack
    from edgevpr.runtime.preflight.estimate import FlightPlan
    from edgevpr.runtime.preflight.offers import offers

    settings, places, map_technique = {}, args.places, None
    if args.map:
        with PlaceMap.open(args.map) as place_map:
            places, map_technique = len(place_map), place_map.spec.name
            settings[map_technique] = place_map.spec.parameters
    battery = load_config(None, {"battery.pack": args.battery}).battery
    plan = FlightPlan(
        places=places,
        rate_hz=board.rate_hz if args.rate_hz is None else args.rate_hz,
        flight_min=args.flight_min,
        pack=parse_pack(battery.pack),
        regulator_efficiency=battery.regulator_efficiency,
        budget_mb=board.budget_mb if args.budget_mb is None else args.budget_mb,
        hover_w=args.hover_w,
    )
    return plan, map_technique, offers(techniques.names(), settings=settings)


def _profile_detect(args: Namespace) -> int:
    from edgevpr.power.detect import detect, findings, profile_text
    from edgevpr.runtime.preflight.ownprofile import require_new_profile, write_profile
    from edgevpr.runtime.preflight.stored import micro_benchmark

    found = detect()
    if args.out:
        require_new_profile(Path(args.out))
    if args.json:
        _print_json(asdict(found))
    else:
        print("\n".join(findings(found)))
    if args.out:
        write_profile(Path(args.out), profile_text(found, micro_benchmark()))
        print(f"edgevpr: {args.out} is written: use it with --board {args.out}.", file=sys.stderr)
    elif found.board is None and not args.json:
        print("--out FILE.yaml writes a profile of it.")
    return 0


def _profile_measure(args: Namespace, quiet: bool) -> int:
    """Measure this machine and keep the figures; `quiet` leaves the table to who asked for more."""
    from edgevpr import techniques
    from edgevpr.helpers.progress import progress
    from edgevpr.power.boards import load_board
    from edgevpr.runtime.preflight import stored as measured
    from edgevpr.runtime.preflight.offers import offers
    from edgevpr.runtime.preflight.ownprofile import measured_profile
    from edgevpr.runtime.preflight.stored_text import format_measured

    path = Path(args.out) if args.out else measured.default_path()
    measured.require_room(path, make=not args.out)
    images, pictures = measured.pictures_of(args.images)
    threads, wanted = load_board("this").threads, offers(techniques.names())
    score = measured.micro_benchmark()
    trials = progress(measured.measure_each(wanted, threads, images), len(wanted), "measuring techniques")
    found = measured.gathered(trials, pictures, threads, score)
    measured.save(found, path)
    try:
        own, said = measured_profile(path, score)
    except EdgevprError as error:
        own, said = None, str(error)
    if args.json and not quiet:
        _print_json({**asdict(found), "file": str(path), "profile": own and str(own), "power": said})
    elif not args.json:
        print(format_measured(found))
        print(f"Kept in {path}.\n{said}\n" if quiet else f"Kept in {path}.\n{said}")
    return 0


def evaluate(args: Namespace) -> int:
    from edgevpr import techniques
    from edgevpr.evaluate import evaluate as evaluation
    from edgevpr.evaluate.curves import plot
    from edgevpr.evaluate.dataset import load_dataset
    from edgevpr.evaluate.tables import results_text
    from edgevpr.helpers.figures import require_picture
    from edgevpr.helpers.progress import progress
    from edgevpr.runtime.preflight.offers import offers, usable

    wanted = [name.strip() for name in args.techniques.split(",") if name.strip()]
    if not wanted:
        raise UsageError(f"--techniques names none: use some of {', '.join(techniques.names())}.")
    if args.candidates is not None and args.candidates < 1:
        raise UsageError(f"--candidates is {args.candidates}: compare at least 1 place in full.")
    if args.sequence is not None and not 1 <= args.sequence <= 100:
        raise UsageError(f"--sequence is {args.sequence}; it must be between 1 and 100.")
    camera = {"camera": args.camera} if args.camera else {}
    settings = {name: dict(camera) if "camera" in techniques.parameters(name) else {} for name in wanted}
    for key, value in _settings(args.param).items():
        name, _, parameter = key.partition(".")
        if name not in settings or not parameter:
            raise UsageError(f"--param {key}: write TECHNIQUE.KEY=VALUE with a technique of --techniques.")
        settings[name][parameter] = value
    if args.plot:
        require_picture(Path(args.plot))
    forms = [form.strip() for form in args.form.split(",")]
    # A wrong setting is said before the first hour of work, and a network that cannot be used stops no other.
    tried = list(usable(offers(wanted, forms, settings)))
    errors = {offer.label: each for offer, each in tried if isinstance(each, ModelError)}
    if len(errors) == len(tried):
        raise next(iter(errors.values()))
    dataset = load_dataset(args.query, args.ref, args.ground_truth)
    results = [
        evaluation.evaluate(offer.name, dataset, offer.settings, args.candidates, progress, args.sequence)
        for offer, _ in tried
        if offer.label not in errors
    ]
    results = evaluation.compare(results)
    if args.plot:
        plot({Path(args.ground_truth).resolve().parent.name: results}, Path(args.plot))
    if args.json:
        _print_json(evaluation.as_json(results))
    else:
        print(results_text(results))
    for label, error in errors.items():
        print(f"edgevpr: {label} was not measured: {error}", file=sys.stderr)
    return 1 if errors else 0


def simulate_autopilot(args: Namespace) -> int:
    from edgevpr.simulate.autopilot import read_track, run_autopilot

    summary = run_autopilot(args.link, args.duration_s, track=read_track(args.track) if args.track else None)
    if args.json:
        _print_json(asdict(summary))
    else:
        print(summary)
    return 0


def simulate_flight(args: Namespace) -> int:
    from edgevpr.simulate.flight import fly_and_write

    if args.seed < 0:
        raise UsageError(f"--seed is {args.seed}: give 0 or more.")
    print(fly_and_write(Path(args.out), args.which, args.seed))
    return 0


def train_calc(args: Namespace) -> int:
    from edgevpr.training.job import train_calc

    unusable: list[ImageError] = []
    result = train_calc(args.images, Path(args.out), args.steps, args.seed, args.resume, unusable)
    if args.json:
        _print_json(asdict(result))
    else:
        print(
            f"{result.model} and {result.card}: {result.steps} steps on {result.pictures} images, equal to PyTorch to "
            f"{result.largest_difference:.1e}"
        )
    return _said(unusable)


def train_words(args: Namespace) -> int:
    from edgevpr.training.words import train_words

    unusable: list[ImageError] = []
    result = train_words(
        args.images, args.model, args.kind, args.count, args.whiten, _path(args.out), args.seed, unusable
    )
    if args.json:
        _print_json(asdict(result))
    else:
        print(
            f"{result.file}: {args.count} words of {result.descriptors} descriptors in {result.pictures} images, mean "
            f"square distance {result.distance:.3f}"
        )
    return _said(unusable)


def models_list(args: Namespace) -> int:
    from edgevpr.resources import model_folders
    from edgevpr.runtime.preflight.networks import list_models

    found = list_models()
    if args.json:
        _print_json([asdict(each) for each in found])
        return 0
    for each in found:
        print(f"{each.name:<20} {'ok   ' if each.ok else 'WRONG'}  {each.title or ''}")
        if each.title:
            head = f", head {each.head}" if each.head else ""
            print(f"{'':<27} {each.licence}; {each.source}")
            print(f"{'':<27} {each.file}; {' and '.join(each.outputs)}{head}")
            print(f"{'':<27} used by {', '.join(each.techniques) or 'none, unless told: --param model=' + each.name}")
        if each.problem:
            print(f"{'':<27} {each.problem}")
    print(f"{len(found)} networks in {' and '.join(map(str, model_folders()))}")
    return 0


def models_verify(args: Namespace) -> int:
    from edgevpr.power.boards import load_board
    from edgevpr.runtime.preflight.networks import verify
    from edgevpr.techniques.networks.card import card_names, load_card

    threads = load_board("this").threads
    names = [args.name] if args.name else card_names()
    if not names:
        raise ModelError("There is no network yet: add one with `edgevpr models add FILE.onnx --card CARD.yaml`.")
    works, wrong = [], {}
    for name in names:
        try:
            works.append(verify(load_card(name), threads))
            if not args.json:
                print(_verified_text(works[-1]))
        except EdgevprError as error:
            wrong[name] = str(error)
    if args.json:
        _print_json({"works": [asdict(each) for each in works], "wrong": wrong})
    for name, problem in wrong.items():
        print(f"edgevpr: {name} cannot be used: {problem}", file=sys.stderr)
    return 1 if wrong else 0


def models_add(args: Namespace) -> int:
    from edgevpr.power.boards import load_board
    from edgevpr.runtime.preflight.networks import add

    verified, card = add(Path(args.file), Path(args.card), load_board("this").threads)
    if args.json:
        _print_json({"card": str(card), **asdict(verified)})
    else:
        print(f"{_verified_text(verified)}\nadded as {card}")
    return 0


def models_quantise(args: Namespace) -> int:
    from edgevpr.evaluate.dataset import load_dataset
    from edgevpr.evaluate.evaluate import evaluate as measured
    from edgevpr.helpers.progress import progress
    from edgevpr.power.boards import load_board
    from edgevpr.runtime.preflight.networks import technique_with
    from edgevpr.training.quantise import quantise

    data = (args.query, args.ref, args.ground_truth)
    if any(data) and not all(data):
        raise UsageError("Recall needs all of --query, --ref and --ground-truth: give those that are missing, or none.")
    dataset = load_dataset(*data) if all(data) else None
    result = quantise(args.name, Path(args.calibrate), load_board("this").threads)
    recall = None
    if dataset:
        recall = {
            each.name: measured(technique, dataset, settings, progress=progress).recall_at_1
            for each in (result.before, result.after)
            for technique, settings in [technique_with(each.name)]
        }
    if args.json:
        _print_json({**asdict(result), "recall_at_1": recall})
        return 0
    for each in (result.before, result.after):
        print(_verified_text(each) + (f", recall@1 {recall[each.name]:.3f}" if recall else ""))
    print(f"calibrated with {result.images} images, written as {result.card}")
    return 0


def _verified_text(verified: "Verified") -> str:
    shapes = ", ".join(f"{output} {'x'.join(map(str, shape))}" for output, shape in verified.shapes.items())
    vector = f"a descriptor of {verified.vector_length} numbers, " if verified.vector_length else ""
    return (
        f"{verified.name}: {verified.title}\n"
        f"  works: {shapes}; {vector}{verified.image_ms:.1f} ms an image, threads: {verified.threads}, "
        f"{verified.network_mb:.0f} MB of RAM beside {verified.runtime_mb:.0f} of onnxruntime, "
        f"{verified.file_mb:.2f} MB on disk"
    )


def demo(args: Namespace) -> int:
    from edgevpr.simulate.demo import run_demo

    print(run_demo(Path(args.out)))
    return 0


def service(args: Namespace) -> int:
    from edgevpr.power.boards import load_board
    from edgevpr.runtime.service.unit import render_unit

    print(render_unit(load_board(args.board), args.config), end="")
    return 0


def _frames(source: "Source", label: str, unusable: list[ImageError]) -> "Iterator[Frame]":
    """Every frame of a source that ends, with progress; an image that cannot be used is said, kept in `unusable`, and
    left out."""
    from edgevpr.helpers.progress import progress

    def until_it_ends() -> "Iterator[Frame | None]":
        while not source.ended:
            try:
                yield source.read(_READ_TIMEOUT_S)
            except ImageError as error:
                _left_out(error, unusable)
                yield None
        source.close()

    return (frame for frame in progress(until_it_ends(), source.total, label) if frame is not None)


def _left_out(error: ImageError, unusable: list[ImageError]) -> None:
    print(f"edgevpr: {error}", file=sys.stderr)
    unusable.append(error)


def _said(unusable: list[ImageError]) -> int:
    if unusable:
        print(f"edgevpr: {len(unusable)} images could not be used (named above).", file=sys.stderr)
    return 1 if unusable else 0


def _settings(pairs: list[str]) -> dict[str, str]:
    """["gt=0.4"] -> {"gt": "0.4"}"""
    for pair in pairs:
        if "=" not in pair:
            raise UsageError(f"--param {pair}: write KEY=VALUE, e.g. gt=0.4.")
    return dict(pair.split("=", 1) for pair in pairs)


def _config(args: Namespace, **others: Any) -> Config:
    """The configuration file, if one is named, under the flags of `run` and `match`."""
    flags = {
        "board": args.board,
        "technique": args.technique,
        "source.uri": args.source,
        "source.camera": args.camera,
        "source.rate_hz": getattr(args, "rate_hz", None),
        "match.matching": args.matching,
        "match.form": args.form,
        "match.candidates": args.candidates,
        "match.sequence": args.sequence,
        "match.min_score": args.min_score,
        "match.min_margin": args.min_margin,
        "match.reach_m_s": getattr(args, "reach_m_s", None),
        "memory.budget_mb": args.budget_mb,
        "mapping.learn": getattr(args, "learn", None),
        "mavlink.link": getattr(args, "link", None),
        "log.path": getattr(args, "log", None),
        "battery.pack": args.battery,
    }
    return load_config(getattr(args, "config", None), flags | others)


def _path(text: str | None) -> Path | None:
    return Path(text) if text else None


def _print_json(value: Any) -> None:
    print(json.dumps(value, indent=2, default=str))
