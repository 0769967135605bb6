"""Recognition of one frame, stage by stage: encode, search, verify, locate, decide, and track the flight.

Flights, `match`, `eval` and the probe use it. It has no link, flight log, thread or clock: the result
depends only on the arguments. A *search pass* is one search of the map for the query of a frame. A query may
take several, at different heights."""

import logging
import math
from dataclasses import replace
from itertools import islice

from edgevpr.core.contract import Descriptor, find_nearest_height
from edgevpr.core.errors import MapError, PlaceError
from edgevpr.core.types import Frame, Vehicle
from edgevpr.frames.level import REPORTED_TILT_SD, Mount, View
from edgevpr.places.layers import read_layers
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.ranking import Ranking, merge_rankings
from edgevpr.places.retrieve import Expectation, compare_places, scan_index
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.decide import Decider, Decision, Matcher, MatchSettings, Verifier
from edgevpr.runtime.recognise.encoder import EncodedFrame, FrameEncoder, explain_failure
from edgevpr.runtime.recognise.hints import RecordedPrior, to_expectation
from edgevpr.runtime.recognise.judge import Verdict, check_texture
from edgevpr.runtime.recognise.levelling import set_picture_heading
from edgevpr.runtime.recognise.locate import Located
from edgevpr.runtime.recognise.odometry import OdometryStep, VisualOdometry
from edgevpr.runtime.recognise.perspective import CommonTilt
from edgevpr.runtime.recognise.place_filter import PlaceFilter
from edgevpr.runtime.recognise.recognition import Recognition
from edgevpr.runtime.recognise.relief import Relief

_log = logging.getLogger(__name__)
_LATER_PASS_FRACTION = 0.4  # fraction of the candidates compared at each height except the first


class Recogniser:
    """Recognises places of an open map, frame after frame.

    `odometry` measures the motion between frames (None: not measured). `prior` makes hints that narrow each query
    (None: the whole map is searched). `place_filter` tracks the flight from query to query (None: each is judged
    alone). Between two frames, `change` sets candidates and mount for the next."""

    def __init__(
        self,
        encoder: FrameEncoder,
        place_map: PlaceMap,
        matcher: Matcher,
        meter: QueryMeter,
        *,
        settings: MatchSettings,
        odometry: VisualOdometry | None = None,
        prior: RecordedPrior | None = None,
        place_filter: PlaceFilter | None = None,
    ) -> None:
        self.encoder, self.place_map, self.meter = encoder, place_map, meter
        self.technique, self.candidates = encoder.technique, settings.candidates
        self._settings, self._odometry, self._place_filter = settings, odometry, place_filter
        self._prior = prior or RecordedPrior()
        self._left_out_reported = 0  # number of unreadable places reported so far
        self._layers = matcher.layers or read_layers(place_map)
        self.matcher, self.index, self.rule = matcher, matcher.index, matcher.rule
        # Places closer together than this show the same ground, so they are not rivals.
        self._footprint_m = max(self._layers.footprints_m, default=0.0)
        # 1-sigma accuracy of a place's position used as a fix: the aircraft may be anywhere between two places.
        self.accuracy_m = max(settings.min_accuracy_m, matcher.index.spacing_m() or 0.0)
        self._decider = Decider(
            place_map=place_map,
            technique=self.technique,
            matcher=matcher,
            settings=settings,
            meter=meter,
            accuracy_m=self.accuracy_m,
        )

    def change(self, *, candidates: int | None = None, mount: Mount | None = None) -> None:
        """Change the number of candidates or the camera mount from the next frame on (None: unchanged). Call this
        between two frames, from the recognition thread."""
        if candidates is not None:
            self.candidates = candidates
        if mount is not None:
            self.encoder = self.encoder.replace_mount(mount)
            self._decider = replace(self._decider, common_tilt=CommonTilt(), relief=Relief())
            self._odometry = VisualOdometry() if self._odometry else None  # the next frame has no odometry

    @property
    def sequence(self) -> int:
        """Number of queries that are matched together."""
        return self.matcher.search.length if self.matcher.search else 1

    @property
    def odometry_interval_s(self) -> float | None:
        """Time from one frame to the next that visual odometry needs (None: motion is not measured)."""
        return self._odometry.interval_s if self._odometry else None

    def step(self, frame: Frame, vehicle: Vehicle | None = None) -> Recognition:
        """Recognise one frame; `vehicle` is the autopilot's report at that moment (None: no report).

        Never raises an Exception: an error in a frame, a place or the technique becomes a rejection with its reason."""
        self.meter.begin()
        query = odometry_step = decision = failure = None
        try:
            query = self.encoder.encode(frame, vehicle, layers=self._layers, scale=self._scale, metered=self.meter.step)
            verifier = Verifier(self.encoder, query.picture, self.index, self.place_map)
            odometry_step = self._measure_odometry(frame, query.view, verifier)
            decision = self._decide(query, verifier, odometry_step)
        except Exception as error:
            _log.debug("%s failed", frame.name, exc_info=True)
            failure = error
        return self._make_event(frame, vehicle, query, odometry_step, decision, failure)

    def measure_motion(self, frame: Frame, vehicle: Vehicle | None = None) -> Recognition:
        """Measure only the motion from the previous frame to this one. Never raises an Exception."""
        self.meter.begin()
        picture = odometry_step = failure = None
        try:
            with self.meter.step("prepare"):
                picture = self.encoder.prepare(frame, vehicle, layers=self._layers, scale=self._scale)
            verifier = Verifier(self.encoder, picture, self.index, self.place_map)
            odometry_step = self._measure_odometry(frame, picture.view, verifier)
        except Exception as error:
            _log.debug("%s failed", frame.name, exc_info=True)
            failure = error
        return replace(self._make_event(frame, vehicle, odometry_step=odometry_step, failure=failure), picture=picture)

    def report_unread(self, error: Exception) -> Recognition:
        """Return the event of a frame that could not be read."""
        self.meter.begin()
        return self._make_event(None, None, failure=error)

    def _make_event(
        self,
        frame: Frame | None,
        vehicle: Vehicle | None,
        query: EncodedFrame | None = None,
        odometry_step: OdometryStep | None = None,
        decision: Decision | None = None,
        failure: Exception | None = None,
    ) -> Recognition:
        """Return the event of a frame; `failure` is the error that ended its recognition (None: no error)."""
        decision = decision or Decision(verdict=Verdict(False, explain_failure(failure)))
        findings, accepted = decision.findings, decision.verdict.accepted
        located = findings.located if findings and accepted else None
        left_out = tuple(islice(self.place_map.left_out.items(), self._left_out_reported, None))
        self._left_out_reported += len(left_out)
        return Recognition(
            frame=frame,
            vehicle=vehicle,
            picture=query.picture if query else None,
            salience=query.salience if query else None,
            descriptor=query.descriptor if query else None,
            odometry=odometry_step,
            hints=decision.hints,
            ranking=findings.ranking if findings else None,
            best=decision.best,
            agreement=findings.agreement if findings else None,
            evidence=findings.evidence if findings else None,
            confidence=decision.confidence,
            track=decision.track,
            accepted=accepted,
            reason=decision.verdict.reason,
            lacks_texture=query is not None and check_texture(query.descriptor, self.rule.min_quality) is not None,
            failed=failure is not None,
            map_lost=isinstance(failure, MapError) and not isinstance(failure, PlaceError),
            left_out=left_out,
            located=located,
            accuracy_m=self._compute_accuracy_m(located, query.view) if located and query else None,
            steps=self.meter.steps(),
            cost=self.meter.cost(),
        )

    def _compute_accuracy_m(self, located: Located, view: View) -> float:
        """Return the accuracy of a position on the Earth, with the errors of the map and of the reported tilt."""
        tilt_m = REPORTED_TILT_SD * (located.height_m or 0.0) if view.is_tilt_known else 0.0
        return max(self._settings.min_accuracy_m, math.hypot(located.accuracy_m, tilt_m))

    @property
    def _scale(self) -> float:
        """Factor by which to enlarge the next picture."""
        return self._prior.scale(self.technique.spec.height_ratios)

    def _measure_odometry(self, frame: Frame, view: View, verifier: Verifier) -> OdometryStep | None:
        """Measure the motion from the previous frame to this one, if its picture is georeferenced."""
        if self._odometry is None or not view.is_georeferenced:
            return None
        with self.meter.step("odometry"):
            return self._odometry.measure(frame.t_mono_s, view, verifier.landmarks)

    def _decide(self, query: EncodedFrame, verifier: Verifier, odometry_step: OdometryStep | None) -> Decision:
        """Search the map for an encoded frame, and update the hints for the next query with the decision."""
        place_filter = self._place_filter
        objection = check_texture(query.descriptor, self.rule.min_quality)
        objection = objection or query.view.reason or (query.salience.reason if query.salience else None)
        if place_filter:
            place_filter.predict(query.frame, query.vehicle, odometry_step, self._prior.height_ratio)
        if objection and self.matcher.search is None:  # a sequence needs every query
            if place_filter:
                place_filter.update_without_match(self.index)
            return Decision(verdict=Verdict(False, objection))
        decision = self._search_heights(query, verifier, place_filter)
        if place_filter:
            place_filter.commit()
        if objection:
            decision = replace(decision, verdict=Verdict(False, objection))
        t_mono_s, accepted, footprint_m = query.frame.t_mono_s, decision.verdict.accepted, query.view.footprint_m
        if decision.best:
            self._prior.update(decision.best, accepted, t_mono_s, self._scale, footprint_m, self._layers)
        if track := decision.track:
            self._prior.update_area(track.estimate, track.mass, t_mono_s)
        return decision

    def _search_heights(self, query: EncodedFrame, verifier: Verifier, place_filter: PlaceFilter | None) -> Decision:
        """Search for a query at the expected height and, if nothing is accepted, at all others."""
        prior, search, height_ratios = self._prior, self.matcher.search, self.technique.spec.height_ratios
        margin_m = max(self.accuracy_m, self.rule.neighbour_m)
        hints = prior.make_hints(set_picture_heading(query.frame, query.view), query.vehicle, self.index, margin_m)
        height_ratio = prior.height_ratio / self._scale
        expected = to_expectation(hints, height_ratio, self.index)
        footprint_m = query.view.footprint_m or prior.footprint_m
        ranking = self._search(query.descriptor, self._layers.narrow_search(expected, self.index, footprint_m))
        if search:
            ranking = search.add_query(ranking, self.index, query.frame.t_mono_s)
        decision = self._decider.decide(ranking, query, hints, verifier, place_filter)
        if decision.verdict.accepted or search or not height_ratios or not prior.searches_heights:
            return decision
        first = find_nearest_height(height_ratios, height_ratio)
        for ratio in height_ratios:
            if ratio != first:
                other = self._search(query.descriptor, replace(expected, height_ratio=ratio), _LATER_PASS_FRACTION)
                ranking = merge_rankings(ranking, other)
        # Matches of all passes are judged together: each may be a rival of the best one.
        return self._decider.decide(ranking, query, hints, verifier, place_filter)

    def _search(self, descriptor: Descriptor, expected: Expectation, fraction: float = 1.0) -> Ranking:
        """Search the map once, comparing this fraction of the candidates. Raises the errors of `compare_places`."""
        query = self._decider.make_query(descriptor, expected)
        with self.meter.step("scan"):
            self.place_map.require_unchanged()
            scanned = scan_index(query)
        with self.meter.step("compare"):
            candidates = self.candidates and max(1, round(fraction * self.candidates))
            return compare_places(query, scanned, candidates, max(self.rule.neighbour_m, self._footprint_m))
