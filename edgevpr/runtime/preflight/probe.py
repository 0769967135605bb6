"""What a technique costs on this machine: it is tried for a moment, on generated or on real pictures."""

import math
import sys
from collections.abc import Iterable, Iterator
from collections.abc import Sequence as Several
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from edgevpr.places.index import PlaceIndex, bytes_per_place, load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import best_scanned, margin, rank
from edgevpr.places.sequence import Sequence, bytes_beside_place, length_of
from edgevpr.power import machine
from edgevpr.power.meter import stage
from edgevpr.types import Descriptor, Frame, StageCost, Technique

_ROUNDS = 3
_PLACES = 6
_SCANNED = 4096
_SCANNED_BYTES = 8 << 20  # at most: on a small board this much is to spare before the map is loaded, and no more
_NOTHING = StageCost(0.0, 0.0)
_LINK_MB = 13.0  # what importing pymavlink adds to the resident memory (measured on x86-64)


@dataclass(frozen=True, slots=True, kw_only=True)
class TechniqueCosts:
    """What a technique costs on one machine: to encode a frame, to compare it in full with one place (read from the map
    file), bytes of a place in RAM and on disk, and the most memory that the process has resident, without a map
    (`process_mb`); `encode_mb` of that is what encoding a frame takes for a moment (None: the kernel does not say).
    `is_network` is whether its pictures go through a network.

    Where there are more than `candidates` places, all are scanned in RAM and only so many compared in full (None: the
    technique has one stage, and compares all of them).
    """

    encode: StageCost
    match_per_place: StageCost
    ram_bytes_per_place: int
    disk_bytes_per_place: int
    process_mb: float
    candidates: int | None = None
    scan_per_place: StageCost = _NOTHING
    encode_mb: float | None = None
    is_network: bool = False

    def match(self, places: int) -> StageCost:
        """Cost of finding one query in a map of `places` places."""
        if self.candidates is None or places <= self.candidates:
            return _times(self.match_per_place, places)
        in_full, scanned = _times(self.match_per_place, self.candidates), _times(self.scan_per_place, places)
        return StageCost(in_full.wall_s + scanned.wall_s, in_full.cpu_s + scanned.cpu_s)

    def places_within(self, wall_s: float, cpu_s: float) -> float:
        """How many places a map may have for a query to be found in it within both times."""
        full = self.match_per_place
        in_full = min(wall_s / full.wall_s, cpu_s / full.cpu_s)
        if self.candidates is None or in_full < self.candidates:
            return in_full
        scan = self.scan_per_place
        rest_wall_s, rest_cpu_s = wall_s - self.candidates * full.wall_s, cpu_s - self.candidates * full.cpu_s
        return min(rest_wall_s / scan.wall_s, rest_cpu_s / scan.cpu_s) if scan.wall_s else math.inf


def noise(count: int) -> list[np.ndarray]:
    """Pictures of 640x480 in which every region says something, so that matching costs the most it can."""
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256, (480, 640), np.uint8) for _ in range(count)]


def probe(technique: Technique, images: Several[np.ndarray] | None = None) -> TechniqueCosts:
    """Try a technique here and now: encode some pictures, and match them in a small map on disk.

    `images` (uint8, (H, W[, 3])) are all encoded, and the median counts, since a real picture may be quick or slow.
    Without them there are a few of `noise`, all alike, and the quickest counts: what other programs take away at the
    moment is no cost of the technique.
    """
    counted = _quickest if images is None else _median
    frames = [Frame(image=image, name=f"trial {i}", t_mono_s=0.0) for i, image in enumerate(images or noise(_ROUNDS))]
    peak_is_new = machine.forget_peak()
    before_mb = machine.rss_mb()
    technique.encode(frames[0].image)  # the first time also starts threads and imports what is imported late
    queries, encodings, matchings = [], [], []
    for frame in frames:
        with stage() as encoding:
            queries.append(technique.encode(frame.image))
        encodings.append(encoding.cost)
    encode_mb = machine.peak_mb() - before_mb if peak_is_new else None
    with TemporaryDirectory() as folder, PlaceMap.create(Path(folder) / "trial.gpkg", technique.spec) as trial_map:
        for i in range(_PLACES):
            trial_map.add(frames[i % len(frames)], queries[i % len(frames)])
        index = load_index(trial_map, technique, _PLACES * bytes_per_place(technique.spec))
        for query in queries:
            with stage() as matching:
                scanned = technique.coarse_scores(query, index.rows, index.mean)
                if technique.spec.fine:
                    for slot, hypotheses in best_scanned(*scanned, np.ones(_PLACES, bool), _PLACES):
                        technique.match(query, trial_map.fine_part(index.place_ids[slot]), hypotheses)
            matchings.append(matching.cost)
    fine = technique.spec.fine
    process_mb = machine.peak_mb() if peak_is_new else machine.rss_mb()
    scan = counted(list(_scans(technique, queries, _many(technique, index), trial_map)))
    return TechniqueCosts(
        encode=counted(encodings),
        # Of few places a scan takes as long as of many: what is in RAM is tried with more of them.
        match_per_place=_times(counted(matchings), 1 / _PLACES) if fine else scan,
        ram_bytes_per_place=bytes_per_place(technique.spec) + bytes_beside_place(length_of(technique, None)),
        disk_bytes_per_place=technique.spec.coarse.nbytes + (fine.nbytes if fine else 0),
        process_mb=process_mb + (0.0 if "pymavlink" in sys.modules else _LINK_MB),
        candidates=technique.candidates if fine else None,
        scan_per_place=scan if fine else _NOTHING,
        encode_mb=encode_mb,
        is_network=technique.spec.model_sha256 is not None,
    )


def _many(technique: Technique, index: PlaceIndex) -> PlaceIndex:
    """Some thousand places, which are those of the index again and again."""
    count = max(_PLACES, min(_SCANNED, _SCANNED_BYTES // technique.spec.row.nbytes))
    unknown = np.full(count, np.nan)
    rows = np.resize(index.rows, (count, *index.rows.shape[1:]))
    return PlaceIndex(
        place_ids=np.arange(count),
        lat_deg=unknown,
        lon_deg=unknown,
        heading_deg=unknown.astype(np.float16),
        rows=rows,
        mean=index.mean,
    )


def _scans(
    technique: Technique, queries: list[Descriptor], index: PlaceIndex, trial_map: PlaceMap
) -> Iterator[StageCost]:
    """Cost of one place in the scan of all. A technique that has nothing else to compare is ranked by it, and followed
    in sequences: both take longer than a scan of bits."""
    length = length_of(technique, None)
    sequence = Sequence(length)
    for number in range(length + len(queries)):
        query = queries[number % len(queries)]
        with stage() as scanning:
            if technique.spec.fine:
                technique.coarse_scores(query, index.rows, index.mean)
            else:
                ranking = rank(technique, query, trial_map, index)
                ranking = sequence.follow(ranking, index, 0.1 * number) if length > 1 else ranking
                margin(ranking, index, 0.0)
        if number >= length:  # before, the sequence was not full
            yield _times(scanning.cost, 1 / len(index))


def probe_each(techniques: Iterable[Technique]) -> Iterator[tuple[str, TechniqueCosts]]:
    """(name, costs) of each technique in turn, so that the caller can say how far it is."""
    for technique in techniques:
        yield technique.spec.name, probe(technique)


def _quickest(costs: list[StageCost]) -> StageCost:
    return min(costs, key=lambda cost: cost.wall_s)


def _median(costs: list[StageCost]) -> StageCost:
    return sorted(costs, key=lambda cost: cost.wall_s)[len(costs) // 2]


def _times(cost: StageCost, count: float) -> StageCost:
    return StageCost(cost.wall_s * count, cost.cpu_s * count)
