"""Evidence for a match: the figures from which its confidence is computed (see `confidence`).

There are four kinds: for a camera that looks straight down, with landmarks (DOWN) or without (DOWN_BARE), and for one
that looks ahead (AHEAD, and AHEAD_PROVEN where landmarks support the match). A place *elsewhere* is outside the best
place's neighbourhood. Regions *agree* if they show the same shift between query and place. A larger figure supports the
match, except `rank_gap`.

* agree: logarithm of the fraction of regions that agree (see `compute_share`)
* lead: `agree` minus the largest `agree` of a place elsewhere
* coverage: logarithm of the fraction of the place's regions that agree, each counted once
* structure: `FineMatch.structure`, how well the structures in both images agree
* likeness: `Support.likeness` (ahead)
* rank_gap: mean logarithm of the rank of the regions (see `Support`), minus the smallest of all places compared (ahead)
* landmarks: logarithm of one plus the number of landmarks that agree as expected (ahead, no model uses it)
* proof: result of `log_inlier_ratio` (ahead)
* twin: agreement of the place with the place of the map that looks most like it (see `LookAlike`), minus the agreement
  of pictures of its own ground; if it is 0 or more, the two are *twins* (ahead). No model uses `twin` or `apart`
* apart: `agree` minus the agreement of these two places with each other (ahead, in a map of single views)
* surroundings: logarithm of `Support.surroundings` (ahead, no model uses it)
* tried: `Ranking.tried`, which is not an input of a regression (see `Model.chance`)"""

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

import numpy as np

from edgevpr.core.contract import FineMatch, TechniqueSpec
from edgevpr.places.index import PlaceIndex
from edgevpr.places.ranking import MAX_NEIGHBOUR_SLOTS, Ranking, outside_neighbourhood
from edgevpr.runtime.recognise.agreement import Agreement

AHEAD = "ahead"
AHEAD_PROVEN = "ahead_proven"
DOWN = "down"
DOWN_BARE = "down_bare"
_FIGURES_DOWN = ("lead", "coverage", "structure")
_DOWN_FIGURES = {DOWN: (*_FIGURES_DOWN, "landmarks"), DOWN_BARE: _FIGURES_DOWN}
_MAP_FIGURES_AHEAD = ("coverage", "likeness", "structure")
_PLACE_FIGURES_AHEAD = ("lead", "coverage", "rank_gap", "structure")
# Names of the figures that decide whether a query shows ground of the map, and which of its places it shows.
MAP_FIGURES = {AHEAD: _MAP_FIGURES_AHEAD, AHEAD_PROVEN: _MAP_FIGURES_AHEAD, **_DOWN_FIGURES}
PLACE_FIGURES = {AHEAD: _PLACE_FIGURES_AHEAD, AHEAD_PROVEN: (*_PLACE_FIGURES_AHEAD, "proof"), **_DOWN_FIGURES}
_MIN_FRACTION = 1e-3  # so that the logarithm exists
# This many landmarks may agree with a place that only looks similar. Smaller numbers are noise, and count as this one.
CHANCE_INLIERS = 8
CHANCE_SHARE = 0.07  # reached by pictures of ground outside the map; used if there is no place elsewhere
# If a place leads by a smaller factor, its landmarks must distinguish it from the best place elsewhere.
SMALL_LEAD = math.log(1.5)
_MIN_LEAD = math.log(1.05)
# Ahead, the largest advantage in rank that the regions of another place may have. Chosen on corridor, where one match
# next to the correct places was accepted.
_MAX_RANK_GAP = 0.1
_MIN_PROOF = math.log(2)
# A place that has a twin must lead by this factor. In thumbs_essex, the lift door of another floor led by 2 when it was
# seen from the spot where this one was mapped.
_MIN_LEAD_OVER_TWIN = math.log(4)
# If the surroundings of a place agree less than this, relative to its middle, the same door may be somewhere else. Of
# 271 right matches in six sets, 3 have less; of 79 wrong ones of places in other surroundings (see confidence.md), 45.
_MIN_SURROUNDINGS = math.log(0.45)


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """Evidence for a match, as described in the module docstring. None: this kind of evidence lacks the figure, or it
    was not measured. `rival` is like `landmarks`, for the best place elsewhere."""

    agree: float
    lead: float
    coverage: float
    structure: float = 0.0
    tried: float = 1.0
    rank_gap: float | None = None
    likeness: float | None = None
    proof: float | None = None
    landmarks: float | None = None
    rival: float | None = None
    twin: float | None = None
    apart: float | None = None
    surroundings: float | None = None

    def figures(self) -> dict[str, float]:
        """Return the known figures by name."""
        return {name: value for name in self.__slots__ if (value := getattr(self, name)) is not None}

    @property
    def kind(self) -> str:
        """Kind of this evidence, derived from the figures it has."""
        if self.looks_ahead:
            return AHEAD_PROVEN if self.proof else AHEAD
        return DOWN if self.landmarks is not None else DOWN_BARE

    @property
    def looks_ahead(self) -> bool:
        """True for a forward camera."""
        return self.likeness is not None

    @property
    def has_twin(self) -> bool:
        """True if the match may show another, similar place: at least half as many landmarks agree with a place
        elsewhere, or the place has a twin in the map and the lead is not large."""
        is_similar = self.rival is not None and _to_count(self.landmarks or 0.0) < 2 * _to_count(self.rival)
        return is_similar or (self.twin is not None and self.twin >= 0 and self.lead < _MIN_LEAD_OVER_TWIN)

    @property
    def has_other_surroundings(self) -> bool:
        """True if only the middle of the place agrees: the same object may be in other surroundings (ahead)."""
        return self.surroundings is not None and self.surroundings < _MIN_SURROUNDINGS

    @property
    def is_unambiguous(self) -> bool:
        """True if no place elsewhere agrees about as well, judging by regions, landmarks and known look-alikes, and the
        surroundings of the place agree too."""
        return self.lead >= _MIN_LEAD and not self.has_twin and not self.has_other_surroundings

    @property
    def needs_landmarks(self) -> bool:
        """True if neither the regions nor the landmarks prove a match (ahead):

        * It may have a twin, because the look-alikes of the map are unknown, and its lead is not large: twice as many
          landmarks must agree.
        * The place has a small lead: ground outside the map may look like the map.
        * It has a small lead, and the regions of another place rank better: twice as many landmarks must agree.
        * It is a single view (see `LookAlikes`), and the query agrees with it hardly better than the most similar
          place does: from another spot, each of the two may look more like the other."""
        if self.likeness is None:
            return False
        may_have_twin = self.twin is None and self.lead < _MIN_LEAD_OVER_TWIN
        if may_have_twin or (self.has_small_lead and (self.rank_gap or 0.0) > _MAX_RANK_GAP):
            return (self.proof or 0.0) < _MIN_PROOF
        if self.apart is not None:
            return self.apart < SMALL_LEAD and not self.proof
        return self.has_small_lead and _to_count(self.landmarks or 0.0) <= CHANCE_INLIERS

    @property
    def has_small_lead(self) -> bool:
        """True if a place elsewhere agrees nearly as well, so its landmarks must be compared too."""
        return self.lead < SMALL_LEAD

    def describe(self) -> dict[str, float | None]:
        """Return this evidence as parameters of a `Reason` of the judge, converted back from logarithms."""
        is_down = self.landmarks is not None and self.likeness is None
        return {
            "regions_ratio": math.exp(self.lead),
            "regions_share": math.exp(self.agree),
            "landmarks": _to_count(self.landmarks) if self.landmarks is not None and is_down else None,
            "rival_landmarks": None if self.rival is None else _to_count(self.rival),
            "landmarks_ratio": math.exp(self.proof) if self.proof and not is_down else None,
            "coverage_share": None if is_down or self.proof else math.exp(self.coverage),
            "surroundings_ratio": math.exp(self.surroundings or 0.0) if self.has_other_surroundings else None,
        }


@dataclass(frozen=True, slots=True)
class LookAlike:
    """The place elsewhere that looks most like a place: its number, and the logarithm of the fraction of regions of
    both that agree. `own`: the same for pictures of the place's own ground, or the chance level if there are none."""

    other_id: int
    agree: float
    own: float


@dataclass(frozen=True, slots=True)
class LookAlikes:
    """The `places` that look alike, by number, in a map that looks ahead. `overlap`: successive pictures show the same
    ground, as along a road. Otherwise each place is a single view: its neighbours in the file show other ground."""

    overlap: bool
    places: Mapping[int, LookAlike]

    @property
    def twins(self) -> int:
        """Number of places that have a twin."""
        return sum(look_alike.agree >= look_alike.own for look_alike in self.places.values())


def list_evidence_kinds(spec: TechniqueSpec) -> tuple[str, ...]:
    """Return the kinds of evidence that a technique provides; none if its matches are judged by fixed limits."""
    if spec.looks_down:
        return DOWN, DOWN_BARE
    return (AHEAD, AHEAD_PROVEN) if spec.scan_counts else ()


def gather_evidence(
    ranking: Ranking,
    index: PlaceIndex,
    neighbour_m: float,
    agreement: Agreement | None,
    same_ground: Collection[int],
    looks_down: bool,
    look_alikes: LookAlikes | None = None,
) -> Evidence | None:
    """Return the evidence for the best place; None if no place was compared or, ahead, a match has no `support`.

    If the camera `looks_down`, `agreement` is that of the landmarks (None: not compared), and places with the numbers
    `same_ground` show the same ground as the best one, so they do not count as elsewhere. `look_alikes` are those of
    the map (None: unknown)."""
    matches = {slot: ranking.compared[slot] for slot in ranking.compared_slots}
    support = {slot: match.support for slot, match in matches.items() if match.support}
    if not matches or (not looks_down and len(support) < len(matches)):
        return None
    slots = np.array(list(matches))
    best = int(slots[0])
    neighbours = count_neighbours(look_alikes)
    same_ids = same_ground if looks_down else ()
    elsewhere = slots[outside_neighbourhood(index, best, slots, neighbour_m, same_ids, neighbours)].tolist()
    shares = {slot: compute_share(match) for slot, match in matches.items()}
    rival_share = max((shares[slot] for slot in elsewhere), default=CHANCE_SHARE)
    evidence = Evidence(
        agree=log_share(shares[best]),
        lead=log_share(shares[best]) - log_share(rival_share),
        coverage=log_share(matches[best].coverage or 0.0),
        structure=matches[best].structure or 0.0,
        tried=ranking.tried,
    )
    if not looks_down:
        least_rank = min(match_support.log_rank for match_support in support.values())
        best_support = support[best]
        rank_gap, likeness = best_support.log_rank - least_rank, best_support.likeness
        surroundings = math.log(best_support.surroundings)
        evidence = replace(evidence, rank_gap=rank_gap, likeness=likeness, proof=0.0, surroundings=surroundings)
        look_alike = look_alikes.places.get(int(index.place_ids[best])) if look_alikes else None
        if look_alikes is None or look_alike is None:
            return evidence
        apart = None if look_alikes.overlap else evidence.agree - look_alike.agree
        return replace(evidence, twin=look_alike.agree - look_alike.own, apart=apart)
    if agreement is None:
        return evidence
    is_valid = agreement.is_expected and not agreement.is_unshifted
    return replace(evidence, landmarks=log_count(agreement.inliers if is_valid else 0))


def count_neighbours(look_alikes: LookAlikes | None) -> int:
    """Return the number of neighbours before and after a place without a position, in mapping order."""
    return MAX_NEIGHBOUR_SLOTS if look_alikes is None or look_alikes.overlap else 0


def log_inlier_ratio(inliers: int, rival: int) -> float:
    """Return the evidence from landmarks of forward cameras: the logarithm of the ratio of `inliers`, the number that
    agree with the best place, to `rival`, the number that agree with the best place elsewhere. Both are raised to the
    number expected by chance. The result is at least 0, so it never counts against a match."""
    return max(0.0, math.log(max(inliers, CHANCE_INLIERS) / max(rival, CHANCE_INLIERS)))


def compute_share(match: FineMatch) -> float:
    """Return the fraction of regions that agree on a shift: ahead, the geometric mean of that of the query's and that
    of the place's regions; down, `FineMatch.votes`, which also counts how well the layouts agree."""
    if match.support is not None:
        return math.sqrt(match.score * match.support.back)
    return match.score if match.votes is None else match.votes


def log_count(landmarks: int) -> float:
    """Convert a number of landmarks to its form in the evidence."""
    return math.log1p(landmarks)


def _to_count(logarithm: float) -> int:
    return round(math.expm1(logarithm))


def log_share(share: float) -> float:
    """Return the logarithm of a fraction, as in the evidence."""
    return math.log(max(share, _MIN_FRACTION))
