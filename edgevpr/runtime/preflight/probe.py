"""Measures the costs of a technique on this machine in a short trial on generated images."""

import itertools
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory

import numpy as np

from edgevpr.core.contract import Technique, TechniqueSpec
from edgevpr.core.errors import ModelError
from edgevpr.core.types import NO_COST, Frame, StageCost, StepCosts
from edgevpr.places.index import PlaceIndex, compute_place_bytes, load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import compute_candidate_factor
from edgevpr.places.rows import MAX_LANDMARK_BYTES
from edgevpr.places.sequence import compute_sequence_bytes, make_sequence_search
from edgevpr.power import machine
from edgevpr.power.boards import load_board
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.decide import Matcher, MatchSettings
from edgevpr.runtime.recognise.encoder import FrameEncoder, explain_failure
from edgevpr.runtime.recognise.judge import AcceptRule
from edgevpr.runtime.recognise.recogniser import Recogniser

_TRIAL_PICTURES = 2
_TRIAL_PLACES = 6
_MAX_TRIES = 5  # of each image, at most
_STEPS = ("encode", "scan", "compare", "verify")
_SCANNED_PLACES = 4096
_MAX_SCANNED_BYTES = 8 << 20  # a small board has no more RAM free before the map is loaded
_PYMAVLINK_MB = 12.0  # resident memory added by importing pymavlink (measured on x86-64)


@dataclass(frozen=True, slots=True, kw_only=True)
class TechniqueCosts:
    """Costs of a technique on one machine: measured, or with times from instruction counts. A `StageCost` is wall time
    and CPU time.

    `encode`: cost of encoding one frame. `match_per_place`: cost of comparing a query with one place, read from the map
    file. `compare_once`: part of the comparison that does not grow with the number of places; if fewer than
    `max_matches` places are compared, only a proportional part of it is paid. `candidates`: number of places compared
    after all places of the map are scanned in RAM (None: the technique has one stage, and compares all places).
    `scan_per_place`: cost of scanning one place. `scan_once`: cost of preparing a query for the scan.
    `tries_rotations`: more candidates are compared in a large map (see `compute_candidate_factor`). `process_mb`: peak
    resident memory of the process without a map. `sequence`: number of queries matched together."""

    encode: StageCost
    match_per_place: StageCost
    ram_bytes_per_place: int
    disk_bytes_per_place: int
    process_mb: float
    candidates: int | None = None
    scan_per_place: StageCost = NO_COST
    scan_once: StageCost = NO_COST
    compare_once: StageCost = NO_COST
    max_matches: int = 1
    tries_rotations: bool = False
    sequence: int = 1

    def match(self, places: int) -> StageCost:
        """Return the cost of matching one query in a map of `places` places."""
        if self.candidates is None:
            return self.match_per_place * places
        compared = min(places, self.candidates * compute_candidate_factor(self.tries_rotations, places))
        full = self.compare_once * min(1.0, compared / self.max_matches)
        return self.scan_once + full + self.match_per_place * compared + self.scan_per_place * places


def compute_ram_bytes(spec: TechniqueSpec, sequence: int) -> int:
    """Return the bytes of RAM per place in a flight that matches `sequence` queries together."""
    return compute_place_bytes(spec) + compute_sequence_bytes(sequence)


def compute_disk_bytes(spec: TechniqueSpec) -> int:
    """Return the bytes per place in the map file, with the maximum number of landmarks."""
    return spec.coarse.nbytes + (spec.fine.nbytes if spec.fine else 0) + (MAX_LANDMARK_BYTES if spec.cells else 0)


def measure_costs(technique: Technique, *, repeat_s: float = 0.0, meter: QueryMeter | None = None) -> TechniqueCosts:
    """Measure the costs of a technique on this machine. The steps of a query are run on images of noise, which cost the
    most to match because every region has structure: first while a small map is filled, then with that map on disk,
    then with a large index.

    Each image is matched repeatedly for about `repeat_s` seconds per map, and the least CPU time is used, because time
    spent in other programs is not a cost of the technique. Raises ModelError if the technique fails on an image."""
    bench = _Bench(technique, meter or QueryMeter(load_board("this")), repeat_s)
    spec, candidates = technique.spec, technique.candidates
    with TemporaryDirectory() as folder, PlaceMap.create(Path(folder) / "trial.gpkg", spec) as trial_map:
        peak_is_new = machine.reset_peak()
        bench.fill(trial_map)
        index = load_index(trial_map, technique, _TRIAL_PLACES * compute_place_bytes(spec))
        # For a technique with one stage, only the memory of a query is measured with the small map.
        small = bench.try_map(trial_map, index, 1, _MAX_TRIES if spec.fine else 1)
        process_mb = machine.read_peak_mb() if peak_is_new else machine.read_rss_mb()
        large_index = _repeat_places(technique, index)
        factor = compute_candidate_factor(bool(spec.height_ratios), len(large_index))
        full_count = round(candidates / factor)
        half_count = round(max(spec.max_matches or 1, candidates // 2) / factor)
        large = bench.try_map(trial_map, large_index, full_count)
        half = bench.try_map(trial_map, large_index, half_count) if spec.max_matches else large
    scan_once = _find_least([steps.scan for steps in small]) if spec.fine else NO_COST
    # With six places, a scan consists only of query preparation and call overhead.
    scan_per_place = _subtract(_find_least([steps.scan if spec.fine else steps.match for steps in large]), scan_once)
    scan_per_place *= 1 / len(large_index)
    full_compare, half_compare = (_find_least([steps.compare for steps in tries]) for tries in (large, half))
    if spec.max_matches:
        match_per_place = _subtract(full_compare, half_compare) * (1 / max(1, factor * (full_count - half_count)))
        # Only an accepted query is verified: here, that of the noise image in the map.
        verify = max((steps.verify for steps in large), key=lambda cost: cost.wall_s)
        compare_once = _subtract(full_compare, match_per_place * candidates) + verify
    else:
        match_per_place, compare_once = full_compare * (1 / candidates) if spec.fine else scan_per_place, NO_COST
    return TechniqueCosts(
        encode=_find_least([steps.encode for steps in [*small, *large]]),
        match_per_place=match_per_place,
        compare_once=compare_once,
        max_matches=spec.max_matches or 1,
        tries_rotations=bool(spec.height_ratios),
        ram_bytes_per_place=compute_ram_bytes(spec, bench.sequence),
        disk_bytes_per_place=compute_disk_bytes(spec),
        process_mb=process_mb + (0.0 if "pymavlink" in sys.modules else _PYMAVLINK_MB),
        candidates=candidates if spec.fine else None,
        scan_per_place=scan_per_place if spec.fine else NO_COST,
        scan_once=scan_once,
        sequence=bench.sequence,
    )


class _Bench:
    """Measures the steps of a technique repeatedly on the same noise images. `sequence`: number of queries that the
    technique matches together. `repeat_s`: seconds for the repetitions."""

    def __init__(self, technique: Technique, meter: QueryMeter, repeat_s: float) -> None:
        self.sequence = technique.spec.sequence
        self._technique, self._meter, self._repeat_s = technique, meter, repeat_s
        rng = Random(0)  # NumPy's generator would load 2.5 MB that a flight does not need
        pictures = [np.frombuffer(rng.randbytes(480 * 640), np.uint8) for _ in range(_TRIAL_PICTURES)]
        self._images = [picture.reshape(480, 640) for picture in pictures]

    def fill(self, trial_map: PlaceMap) -> None:
        """Add the trial's places to a map; all are copies of the first image."""
        encoder = FrameEncoder(technique=self._technique)
        frame = Frame(image=self._images[0], name="trial", t_mono_s=0.0)
        try:
            encoded = encoder.encode(frame)
        except Exception as error:
            raise ModelError(str(explain_failure(error))) from error
        for _ in range(_TRIAL_PLACES):
            trial_map.add(frame, encoded.descriptor, landmarks=encoder.pack_landmarks(encoded.picture))

    def try_map(
        self, place_map: PlaceMap, index: PlaceIndex, candidates: int, max_tries: int = _MAX_TRIES
    ) -> list[StepCosts]:
        """Match each image up to `max_tries` times with `place_map`, whose `index` is in RAM, comparing `candidates`
        places. Returns one `StepCosts` per image: the least cost of each step."""
        technique, settings = self._technique, MatchSettings(candidates=candidates)
        rule = AcceptRule(min_score=technique.min_score, min_margin=technique.min_margin, neighbour_m=0.0)
        matcher = Matcher(index, rule, make_sequence_search(self.sequence))
        recogniser = Recogniser(FrameEncoder(technique=technique), place_map, matcher, self._meter, settings=settings)
        times_s = (0.1 * number for number in itertools.count())

        def match_pictures() -> list[StepCosts]:
            frames = [Frame(image=image, name="trial", t_mono_s=next(times_s)) for image in self._images]
            events = [recogniser.step(frame) for frame in frames]
            for event in events:
                if event.failed:
                    raise ModelError(str(event.reason))
            return [event.steps for event in events]

        for _ in range(math.ceil((self.sequence - 1) / len(self._images))):
            match_pictures()  # fill the sequence before measuring
        end_s, rounds = time.monotonic() + self._repeat_s, [match_pictures()]
        while len(rounds) < max_tries and time.monotonic() < end_s:
            rounds.append(match_pictures())
        return [
            StepCosts(**{name: _find_least([getattr(steps, name) for steps in tries]) for name in _STEPS})
            for tries in zip(*rounds, strict=True)
        ]


def _repeat_places(technique: Technique, index: PlaceIndex) -> PlaceIndex:
    """Return an index of several thousand places without positions, made by repeating the places of `index`."""
    count = max(_TRIAL_PLACES, min(_SCANNED_PLACES, _MAX_SCANNED_BYTES // technique.spec.row.nbytes))
    unknown = np.full(count, np.nan)
    return PlaceIndex(
        place_ids=np.resize(index.place_ids, count),
        lat_deg=unknown,
        lon_deg=unknown,
        heading_deg=unknown.astype(np.float16),
        rows=np.resize(index.rows, (count, *index.rows.shape[1:])),
        mean=index.mean,
    )


def _subtract(cost: StageCost, part: StageCost) -> StageCost:
    """Return `cost` minus `part`, but at least a thousandth of `cost`, because clocks are inexact."""
    minimum = cost * 0.001
    return StageCost(max(cost.wall_s - part.wall_s, minimum.wall_s), max(cost.cpu_s - part.cpu_s, minimum.cpu_s))


def _find_least(costs: list[StageCost]) -> StageCost:
    """Return the least cost of several tries: the least CPU time, and as wall time the lesser of the least wall time
    and the least CPU time. This excludes time spent waiting for other programs, and still allows for work on several
    cores, whose wall time is less than its CPU time."""
    cpu_s = min(cost.cpu_s for cost in costs)
    return StageCost(min(cpu_s, *(cost.wall_s for cost in costs)), cpu_s)
