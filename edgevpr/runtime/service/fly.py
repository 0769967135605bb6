"""A flight from start to end: everything is opened, flown with, and closed; SIGTERM and SIGINT end it."""

import logging
import os
import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from edgevpr import __version__
from edgevpr.config import Config
from edgevpr.errors import MapError, UsageError
from edgevpr.frames.source import open_source
from edgevpr.mavlink.address import parse_link
from edgevpr.mavlink.link import Link
from edgevpr.runtime.flight.flightlog import FlightLog, start_fields
from edgevpr.runtime.flight.loop import Flight, say_learning_stopped
from edgevpr.runtime.flight.systemd import notify
from edgevpr.runtime.recognise.learn import Learner, check_positions
from edgevpr.runtime.recognise.pipeline import Pipeline, open_learning, open_pipeline

_log = logging.getLogger(__name__)


def fly(config: Config, positions: Path | None = None) -> int:
    """Open everything, fly, close everything; returns the exit code. Raises a sentence where it cannot start."""
    if config.source.uri is None:
        raise UsageError("There is no source of frames: name one with --source, or `source: {uri: ...}`.")
    address = parse_link(config.mavlink.link) if config.mavlink.link else None
    learner = cannot_learn = None
    if config.mapping.learn:
        check_positions(config, positions)
    with ExitStack() as stack:
        if config.mapping.learn:
            pipeline, learner, cannot_learn = _open_learner(config)
        else:
            pipeline = open_pipeline(config)
        stack.callback(pipeline.place_map.close)
        _log.info("version %s on %s", __version__, pipeline.board.title)
        _log.info("%s", pipeline.reason)
        flight_log = stack.enter_context(FlightLog(config.log.path, wait="NOTIFY_SOCKET" in os.environ))
        board = pipeline.board
        if not board.verified:
            _log.warning("mAh are estimates: the power of %s is unverified (%s)", board.title, board.source)
        decided = {
            "reason": pipeline.reason,
            "rule": pipeline.rule,
            "candidates": pipeline.candidates,
            "sequence": pipeline.sequence.length if pipeline.sequence else 1,
            "accuracy_m": pipeline.accuracy_m,
            "rate_hz": pipeline.rate_hz,
            "idle_w": board.idle_w,
            "full_w": board.full_w,
            "power_verified": board.verified,
        }
        flight_log.write("start", **start_fields(config, board.name, pipeline.technique.spec), decided=decided)
        link = stack.enter_context(Link(address, config.mavlink.component_id)) if address else None
        if link and (learner or config.match.reach_m_s or pipeline.looks_down):
            link.want_position()
        source = open_source(config.source.uri, step_s=1 / pipeline.rate_hz, positions=positions, live=True)
        stack.callback(source.close)
        if link and config.mavlink.send_fixes and source.total:
            _log.warning(
                "%s is a recording: the fixes sent say where it was made, not where you are", config.source.uri
            )
        if cannot_learn:
            say_learning_stopped(cannot_learn, flight_log, link)
        if learner and link and source.total:
            _log.warning("%s is a recording: what it learns is put where the vehicle is now", config.source.uri)
        flight = Flight(pipeline, source, flight_log, link, config, learner)
        stack.callback(flight.close)
        place_map = pipeline.place_map
        del pipeline  # the flight may have to let go of its index
        with _signals(flight):
            notify(READY=1)
            flight.run()
            notify(STOPPING=1)
        if link:
            link.close()  # what waits is sent first, so that the log's last line counts it
        totals = flight.totals
        flight_log.write(
            "end",
            accepted=flight.accepted,
            unusable=flight.unusable,
            **totals,
            mavlink=link.stats() if link else None,
            **({"learnt": learner.totals} if learner else {}),
        )
        _log.info(
            "%d queries, %d accepted, %.3f mAh (%.3f of them for recognising)",
            flight.queries,
            flight.accepted,
            totals["used_mah"],
            totals["marginal_mah"],
        )
        if learner:
            _log.info("%s, %d in %s", learner.summary, len(place_map), config.map)
    return 1 if flight.unusable else 0


def _open_learner(config: Config) -> tuple[Pipeline, Learner | None, str | None]:
    """The pipeline of a flight that learns and its learner or, where the map cannot be written (a card that has become
    read-only, a full disk), the pipeline alone and why: what the map knows is recognised all the same."""
    try:
        pipeline, growing = open_learning(config)
    except MapError as error:
        try:
            return open_pipeline(config), None, str(error)
        except MapError:
            raise error from None
    return pipeline, Learner(pipeline.place_map, growing, config.mapping.spacing_m), None


@contextmanager
def _signals(flight: Flight) -> Iterator[None]:
    """SIGTERM and SIGINT end the flight while this lasts."""
    before = {number: signal.signal(number, flight.stop) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
