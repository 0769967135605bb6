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
from edgevpr.errors import EdgevprError, ImageError, UsageError

if TYPE_CHECKING:
    from edgevpr.runtime.frames import Source
    from edgevpr.types import Frame

_log = logging.getLogger(__name__)
_READ_TIMEOUT_S = 1.0


def map_build(args: Namespace) -> int:
    from edgevpr import techniques
    from edgevpr.places.mapfile import PlaceMap
    from edgevpr.runtime.frames import open_source
    from edgevpr.runtime.mapping import build_map
    from edgevpr.runtime.pipeline import technique_of

    step_s = 1 / args.rate_hz if args.rate_hz else None
    source = open_source(args.source, step_s=step_s, positions=_path(args.positions), live=False)
    settings = _settings(args.param)
    if args.camera:
        settings["camera"] = args.camera
    if args.append and Path(args.map).exists():
        place_map = PlaceMap.open_for_adding(args.map)
        technique = technique_of(place_map, args.technique, settings)
    else:
        name = args.technique or _picked_technique(args.board, source.total)
        technique = techniques.create(name, settings)
        place_map = PlaceMap.create(args.map, technique.spec)
    unusable: list[ImageError] = []
    with place_map:
        result = build_map(_frames(source, "mapping", unusable), technique, place_map)
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
    from edgevpr.runtime.pipeline import technique_of

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
    from edgevpr.places.geojson import write_geojson
    from edgevpr.places.mapfile import PlaceMap

    with PlaceMap.open(args.map) as place_map:
        if args.geojson == "-":
            write_geojson(place_map, sys.stdout)
            return 0
        out_path = Path(args.geojson)
        if out_path.exists() and out_path.samefile(args.map):
            raise UsageError(f"--geojson {out_path} is the map itself: give another name.")
        unfinished = out_path.with_name(out_path.name + ".part")
        with open(unfinished, "w", encoding="utf-8") as out:
            count = write_geojson(place_map, out)
        unfinished.replace(out_path)
    print(f"{out_path}: {count} places")
    return 0


def match(args: Namespace) -> int:
    from edgevpr.geodesy import distance_m
    from edgevpr.runtime.frames import open_source
    from edgevpr.runtime.pipeline import open_pipeline
    from edgevpr.runtime.record import record

    pipeline = open_pipeline(_config(args, map=args.map), _settings(args.param))
    found = []
    unusable: list[ImageError] = []
    source = open_source(args.source, positions=_path(args.positions), live=False)
    for frame in _frames(source, "matching", unusable):
        fields = record(pipeline.step(frame))
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
    return _said(unusable)


def run(args: Namespace) -> int:
    from edgevpr.runtime.service import fly

    code = fly(_config(args, map=args.map), _path(args.positions))
    if threading.active_count() > 1:
        # A capture thread hangs in a stream that does not answer; FFmpeg would abort the end of the interpreter.
        sys.stderr.flush()
        os._exit(code)
    return code


def check(args: Namespace) -> int:
    from edgevpr.runtime.check import check as findings_of

    findings = findings_of(args.config)
    for finding in findings:
        print(f"{'ok   ' if finding.ok else 'WRONG'}  {finding.what:<14} {finding.message}")
    return 0 if all(finding.ok for finding in findings) else 1


def profile(args: Namespace) -> int:
    from edgevpr import techniques
    from edgevpr.config import load_config
    from edgevpr.places.mapfile import PlaceMap
    from edgevpr.power.boards import board_names, load_board
    from edgevpr.power.equations import parse_pack
    from edgevpr.runtime.choose import probe_each
    from edgevpr.runtime.estimate import FlightPlan, estimate, format_table
    from edgevpr.runtime.progress import progress

    if args.list:
        for name in board_names():
            print(f"{name:<20} {load_board(name).title}")
        return 0
    board, here = load_board(args.board), load_board("this")
    settings = {}
    if args.map:
        with PlaceMap.open(args.map) as place_map:
            places = len(place_map)
            settings[place_map.spec.name] = place_map.spec.parameters
    elif args.places is not None:
        places = args.places
    else:
        raise UsageError("Say how many places will be flown with: --map MAP, or --places N.")
    battery = load_config(None, {"battery.pack": args.battery}).battery
    plan = FlightPlan(
        places,
        board.rate_hz if args.rate_hz is None else args.rate_hz,
        args.flight_min,
        parse_pack(battery.pack),
        battery.regulator_efficiency,
        board.budget_mb if args.budget_mb is None else args.budget_mb,
    )
    names = techniques.names()
    tried = (techniques.create(name, settings.get(name)) for name in names)
    probed = progress(probe_each(tried), len(names), "probing techniques")
    result = estimate(board, here, dict(probed), plan)
    if args.json:
        _print_json(asdict(result))
    else:
        print(format_table(result))
    return 0


def evaluate(args: Namespace) -> int:
    from edgevpr import techniques
    from edgevpr.evaluate import evaluate as evaluation
    from edgevpr.evaluate.dataset import load_dataset
    from edgevpr.evaluate.tables import results_text
    from edgevpr.runtime.progress import progress

    wanted = [name.strip() for name in args.techniques.split(",") if name.strip()]
    if not wanted:
        raise UsageError(f"--techniques names none: use some of {', '.join(techniques.names())}.")
    if args.candidates is not None and args.candidates < 1:
        raise UsageError(f"--candidates is {args.candidates}: compare at least 1 place in full.")
    camera = {"camera": args.camera} if args.camera else {}
    settings = {name: dict(camera) if "camera" in techniques.parameters(name) else {} for name in wanted}
    for key, value in _settings(args.param).items():
        name, _, parameter = key.partition(".")
        if name not in settings or not parameter:
            raise UsageError(f"--param {key}: write TECHNIQUE.KEY=VALUE with a technique of --techniques.")
        settings[name][parameter] = value
    for name in wanted:  # a wrong setting is said before the first hour of work
        techniques.create(name, settings[name])
    dataset = load_dataset(args.query, args.ref, args.ground_truth)
    results = [evaluation.evaluate(name, dataset, settings[name], args.candidates, progress) for name in wanted]
    results = evaluation.compare(results)
    if args.json:
        _print_json(evaluation.as_json(results))
    else:
        print(results_text(results))
    return 0


def simulate_autopilot(args: Namespace) -> int:
    from edgevpr.simulate.autopilot import run_autopilot

    summary = run_autopilot(args.link, args.duration_s)
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


def demo(args: Namespace) -> int:
    from edgevpr.simulate.demo import run_demo

    print(run_demo(Path(args.out)))
    return 0


def service(args: Namespace) -> int:
    from edgevpr.power.boards import load_board
    from edgevpr.runtime.unit import render_unit

    print(render_unit(load_board(args.board), args.config), end="")
    return 0


def _frames(source: "Source", label: str, unusable: list[ImageError]) -> "Iterator[Frame]":
    """Every frame of a source that ends, with progress; an image that cannot be used is said, kept in `unusable`, and
    left out."""
    from edgevpr.runtime.progress import progress

    def until_it_ends() -> "Iterator[Frame | None]":
        while not source.ended:
            try:
                yield source.read(_READ_TIMEOUT_S)
            except ImageError as error:
                print(f"edgevpr: {error}", file=sys.stderr)
                unusable.append(error)
                yield None
        source.close()

    return (frame for frame in progress(until_it_ends(), source.total, label) if frame is not None)


def _picked_technique(board_name: str, places: int | None) -> str:
    """The best technique that the board can afford; the reason is logged in one line."""
    from edgevpr import techniques
    from edgevpr.power.boards import load_board
    from edgevpr.runtime.choose import choose, on_board, probe_each

    board, here = load_board(board_name), load_board("this")
    costs = {name: on_board(cost, here, board) for name, cost in probe_each(map(techniques.create, techniques.names()))}
    choice = choose(board, costs, places or 1, board.rate_hz, board.budget_mb)
    _log.info("technique %s", choice.reason)
    return choice.technique


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
        "match.candidates": args.candidates,
        "match.min_score": args.min_score,
        "match.min_margin": args.min_margin,
        "memory.budget_mb": args.budget_mb,
        "mavlink.link": getattr(args, "link", None),
        "log.path": getattr(args, "log", None),
        "battery.pack": args.battery,
    }
    return load_config(getattr(args, "config", None), flags | others)


def _path(text: str | None) -> Path | None:
    return Path(text) if text else None


def _print_json(value: Any) -> None:
    print(json.dumps(value, indent=2, default=str))
