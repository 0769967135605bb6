"""Evidence of a match: the figures that its confidence is computed from (see `confidence`), and map calibration.

There are four kinds: for a camera that looks straight down, with landmarks (DOWN) or without (DOWN_BARE), and for one
that looks ahead (AHEAD, and AHEAD_PROVEN where landmarks speak for the match). A place *elsewhere* is outside the best
place's neighbourhood. Regions *agree* if they show the same shift between query and place. Larger figures speak for the
match, but for `rank_gap`.

* agree: logarithm of what `compute_share` returns, the share of regions that agree
* lead: `agree` minus the largest `agree` of a place elsewhere
* coverage: logarithm of the share of the place's regions that agree, each counted once
* structure: `FineMatch.structure`
* likeness: `Support.likeness` (ahead)
* rank_gap: mean logarithm of the rank of the regions (see `Support`), minus the least of all places compared (ahead)
* landmarks: logarithm of one more than the number of landmarks that agree as expected (down)
* proof: what `log_times_more` returns, of the landmarks (ahead)
* tried: `Ranking.tried`, which no model weighs (see `Model.chance`)
"""

import json
import logging
import math
import zlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from edgevpr.core.contract import FineMatch, TechniqueSpec
from edgevpr.core.errors import MapError
from edgevpr.places.index import PlaceIndex
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.retrieve import Ranking, elsewhere
from edgevpr.runtime.recognise.agreement import Agreement
from edgevpr.runtime.recognise.confidence import Model, prior, select_model

AHEAD, AHEAD_PROVEN, DOWN, DOWN_BARE = "ahead", "ahead_proven", "down", "down_bare"
_BARE = ("lead", "coverage", "structure")
_LOOKING_DOWN = {DOWN: (*_BARE, "landmarks"), DOWN_BARE: _BARE}
_MAP_AHEAD = ("coverage", "likeness", "structure")
_PLACE_AHEAD = ("lead", "coverage", "rank_gap", "structure")
# Names of the evidence that tells whether a query shows ground of the map, and which of its places.
OF_MAP = {AHEAD: _MAP_AHEAD, AHEAD_PROVEN: _MAP_AHEAD, **_LOOKING_DOWN}
OF_PLACE = {AHEAD: _PLACE_AHEAD, AHEAD_PROVEN: (*_PLACE_AHEAD, "proof"), **_LOOKING_DOWN}
_MIN_SHARE = 1e-3  # so that its logarithm exists
# So many landmarks agree with a place that only looks alike. Were fewer told apart, wrong matches would scatter more.
_INLIERS_BY_CHANCE = 8
_SHARE_BY_CHANCE = 0.07  # that pictures of foreign ground reach; stands for a place elsewhere if there is none
# A place that leads by a smaller factor must be told by its landmarks from the best one elsewhere.
_SMALL_LEAD = math.log(1.5)
_NO_LEAD = math.log(1.05)
FEWEST_PLACES = 30  # a map with fewer is not calibrated
_MIN_RECOGNISABLE = 0.5  # mean confidence below which a place is hardly recognisable
_CHECKSUM_DIGITS = 8

_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True, kw_only=True)
class Evidence:
    """Evidence of a match, as the module describes it. None: this kind of evidence has no such figure, or it was not
    asked for. `rival` is the number of landmarks, as `landmarks`, that agree with the best place elsewhere."""

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

    def figures(self) -> dict[str, float]:
        """Return the figures that are known, by their names."""
        return {name: value for name in self.__slots__ if (value := getattr(self, name)) is not None}

    @property
    def kind(self) -> str:
        """Kind of this evidence, by the figures it has."""
        if self.likeness is not None:
            return AHEAD_PROVEN if self.proof else AHEAD
        return DOWN if self.landmarks is not None else DOWN_BARE

    @property
    def has_twin(self) -> bool:
        """True if at least half as many landmarks agree with a place elsewhere: both show the same kind of thing."""
        return self.rival is not None and _to_count(self.landmarks or 0.0) < 2 * _to_count(self.rival)

    @property
    def leads(self) -> bool:
        """True if no place elsewhere agrees about as well, by the regions and by the landmarks."""
        return self.lead >= _NO_LEAD and not self.has_twin

    @property
    def is_hardly_ahead(self) -> bool:
        """True if a place elsewhere agrees nearly as well, so that its landmarks must be compared too."""
        return self.lead < _SMALL_LEAD

    def describe(self) -> dict[str, float | None]:
        """Return this evidence as parameters of a `Reason` of the judge, without logarithms."""
        is_down = self.landmarks is not None
        return {
            "regions_ratio": math.exp(self.lead),
            "regions_share": math.exp(self.agree),
            "landmarks": None if self.landmarks is None else _to_count(self.landmarks),
            "rival_landmarks": None if self.rival is None else _to_count(self.rival),
            "landmarks_ratio": math.exp(self.proof) if self.proof and not is_down else None,
            "coverage_share": None if is_down or self.proof else math.exp(self.coverage),
        }


@dataclass(frozen=True, slots=True, kw_only=True)
class MapCalibration:
    """Calibration of a map: the result of looking for a number (`asked`) of altered pictures of its own places.
    `models` maps kinds of evidence to the models adapted to the map, and `made` is the date. At the `precision` that
    the calibration was made for, the share `accepted` of the pictures is accepted. `accepted_wrong` of the accepted
    matches are wrong, among them those of places that were left out of the map for the test. `recognisable` maps the
    number of each place tested to the mean confidence (0..1) of its right matches."""

    models: Mapping[str, Model]
    made: str
    asked: int
    precision: float
    accepted: float
    accepted_wrong: int
    recognisable: Mapping[int, float] = field(default_factory=dict)

    @property
    def hardly_recognisable(self) -> float:
        """Share of the tested places that are hardly recognisable."""
        return sum(each < _MIN_RECOGNISABLE for each in self.recognisable.values()) / max(len(self.recognisable), 1)

    @property
    def looks_alike(self) -> bool:
        """True if more than half of the tested places are hardly recognisable."""
        return self.hardly_recognisable > 0.5

    def figures(self) -> dict[str, Any]:
        """Return the figures as a dict for JSON."""
        kept = ("made", "asked", "precision", "accepted_wrong", "looks_alike")
        return {name: getattr(self, name) for name in kept} | {
            "made_of": [model.made_of for model in self.models.values()],
            "places_asked": len(self.recognisable),
            "accepted": round(self.accepted, 4),
            "hardly_recognisable": round(self.hardly_recognisable, 4),
        }

    def described(self) -> str:
        """Describe the calibration in one sentence: matches accepted, wrong matches, and hardly recognisable places."""
        if not self.recognisable:  # see `of_several`
            return (
                f"the most cautious of its parts counts: of {self.asked} altered copies of their own images at least "
                f"{100 * self.accepted:.0f} % were accepted, at a precision of {100 * self.precision:.6g} %"
            )
        wrong = f"{self.accepted_wrong or 'no'} wrong match{'es were' if self.accepted_wrong > 1 else ' was'} accepted"
        alike = "; most of this map looks alike: expect few fixes over it" if self.looks_alike else ""
        return (
            f"of {self.asked} altered copies of its own images {100 * self.accepted:.0f} % were accepted, at a "
            f"precision of {100 * self.precision:.6g} %; {wrong}; {100 * self.hardly_recognisable:.0f} % of "
            f"{len(self.recognisable)} places are hard to recognise{alike}"
        )


def list_evidence_kinds(spec: TechniqueSpec) -> tuple[str, ...]:
    """Return the kinds of evidence that a technique gives; an empty tuple if its matches are judged by fixed limits."""
    if spec.looks_down:
        return DOWN, DOWN_BARE
    return (AHEAD, AHEAD_PROVEN) if spec.scan_counts else ()


def require_usable(kind: str, model: Model) -> None:
    """Check a model read from a map. Raises ValueError for an unknown kind or name of evidence, as another version of
    edgevpr may have, and ValueError or ArithmeticError for figures with which no confidence can be computed."""
    known = OF_MAP.get(kind, ()) + OF_PLACE.get(kind, ())
    names = {name for each in (model.of_map, model.of_place, *model.of_other_places) for name in each.names}
    if unknown := names.difference(known):
        raise ValueError(f"there is no evidence {min(unknown)!r:.40} of kind {kind!r:.40}")
    for value in (-1.0, 0.0, 1.0):
        model.confidence(dict.fromkeys(known, value))
    model.threshold(0.999999)


def gather_evidence(
    ranking: Ranking, index: PlaceIndex, neighbour_m: float, proof: Agreement | None, same: Collection[int], down: bool
) -> Evidence | None:
    """Return the evidence for the best place; None if no place was compared or, ahead, a match has no `support`.

    `down` tells whether the camera looks straight down. If so, `proof` is the agreement of the landmarks (None: not
    compared), and the places with the numbers `same` show the same ground as the best one, so they are not elsewhere.
    """
    matches = {slot: ranking.compared[slot] for slot in ranking.compared_slots}
    support = {slot: match.support for slot, match in matches.items() if match.support}
    if not matches or (not down and len(support) < len(matches)):
        return None
    slots = np.array(list(matches))
    best = int(slots[0])
    away = frozenset(slots[elsewhere(index, best, slots, neighbour_m, same if down else ())].tolist())
    agree = {slot: compute_share(match) for slot, match in matches.items()}
    rivals = (agree[slot] for slot in away)
    evidence = Evidence(
        agree=log_share(agree[best]),
        lead=log_share(agree[best]) - log_share(max(rivals, default=_SHARE_BY_CHANCE)),
        coverage=log_share(matches[best].coverage or 0.0),
        structure=matches[best].structure or 0.0,
        tried=ranking.tried,
    )
    if not down:
        least_rank = min(each.log_rank for each in support.values())
        ahead = support[best]
        return replace(evidence, rank_gap=ahead.log_rank - least_rank, likeness=ahead.likeness, proof=0.0)
    if proof is None:
        return evidence
    return replace(evidence, landmarks=log_count(proof.inliers if proof.is_expected and not proof.is_at_rest else 0))


def log_times_more(inliers: int, rival: int) -> float:
    """Return the evidence of the landmarks, ahead, where `inliers` agree with those of the best place and `rival` with
    those of the best place elsewhere: the logarithm of how many times more agree than with the rival and by chance. It
    is 0 at least, so it never speaks against a match."""
    return max(0.0, math.log(max(inliers, _INLIERS_BY_CHANCE) / max(rival, _INLIERS_BY_CHANCE)))


def compute_share(match: FineMatch) -> float:
    """Return the share of regions that agree on a shift. Ahead it is the geometric mean of the score and of the same
    share of the place; down, `FineMatch.votes`, which counts how well the layouts agree, too."""
    if match.support is not None:
        return math.sqrt(match.score * match.support.back)
    return match.score if match.votes is None else match.votes


def read_calibration_for(place_map: PlaceMap) -> MapCalibration | None:
    """Return the calibration of a map; None if it has none, or, after a warning in the log, if it is unusable."""
    try:
        text = place_map.calibration
        if text is None:
            return None
        found = read_calibration(text)
        for kind, model in found.models.items():
            require_usable(kind, model)
    except (ValueError, ArithmeticError, KeyError, TypeError, AttributeError, MapError) as error:
        _log.warning(
            "%s: its calibration cannot be used (%s): the shipped one is used; `edgevpr map calibrate` makes it anew",
            place_map.path,
            error,
        )
        return None
    return found


def of_several(maps: Sequence[MapCalibration | None]) -> MapCalibration | None:
    """Join the calibrations of maps whose places are put together (None: a map has none): a match is only accepted if
    each of them accepts it, and the shipped confidence, if one has none. Places of different maps that look alike were
    never seen together. Returns None if no map has one, or if different versions have made them."""
    known = [each for each in maps if each]
    if not known:
        return None
    models = {}
    for kind in known[0].models:
        shipped, own = prior(kind), [each.models[kind] for each in known if kind in each.models]
        scale = shipped.adapted_scale or shipped.scale
        if len(own) < len(known) or any((each.of_map, each.scale) != (shipped.of_map, scale) for each in own):
            return None
        of_places = [place for each in own for place in (each.of_place, *each.of_other_places)]
        if len(known) < len(maps):  # its scale is the stricter one, see `Model.threshold`
            of_places, scale = [*of_places, shipped.of_place], shipped.scale
        models[kind] = Model(
            of_map=shipped.of_map,
            of_place=of_places[0],
            of_other_places=tuple(dict.fromkeys(of_places[1:])),
            scale=scale,
            adapted_scale=shipped.adapted_scale if len(known) < len(maps) else None,
            made=min(each.made for each in known),
            made_of=f"the calibrations of {len(known)} of {len(maps)} maps",
        )
    return MapCalibration(
        models=models,
        made=min(each.made for each in known),
        asked=sum(each.asked for each in known),
        precision=max(each.precision for each in known),
        accepted=min(each.accepted for each in known),
        accepted_wrong=sum(each.accepted_wrong for each in known),
    )


def not_calibrated(places: int) -> str:
    """Return a sentence for a map with so many places: it is not calibrated, and why."""
    if places < FEWEST_PLACES:
        return f"not calibrated ({places} places: fewer than {FEWEST_PLACES}): the shipped confidence is used"
    return "not calibrated: the shipped confidence is used; `edgevpr map calibrate` makes its own of its pictures"


def calibration_text(calibration: MapCalibration) -> str:
    """Write a calibration as text for `read_calibration`: the CRC-32 of the JSON that follows, then the JSON."""
    body = json.dumps(asdict(calibration))
    return _checksum(body) + body


def read_calibration(text: str) -> MapCalibration:
    """Read a calibration from the text in a map. Raises ValueError if it is damaged, KeyError, TypeError or
    AttributeError if another version has written it in another form."""
    body = text[_CHECKSUM_DIGITS:]
    if text != _checksum(body) + body:
        raise ValueError("its checksum is wrong")
    found = json.loads(body)
    found["models"] = {kind: select_model(model) for kind, model in found["models"].items()}
    found["recognisable"] = {int(place_id): each for place_id, each in found["recognisable"].items()}
    return MapCalibration(**found)


def log_count(landmarks: int) -> float:
    """Return a number of landmarks as it stands in the evidence."""
    return math.log1p(landmarks)


def _to_count(logarithm: float) -> int:
    return round(math.expm1(logarithm))


def log_share(share: float) -> float:
    """Return the logarithm of a share, as in the evidence."""
    return math.log(max(share, _MIN_SHARE))


def _checksum(body: str) -> str:
    return f"{zlib.crc32(body.encode('utf-8', 'surrogatepass')):0{_CHECKSUM_DIGITS}x}"
