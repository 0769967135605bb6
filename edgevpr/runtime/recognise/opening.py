"""Makes a recogniser from a map, the technique that built it, and its index in RAM. Every program starts here."""

import logging
from collections.abc import Collection, Mapping
from contextlib import ExitStack

from edgevpr import techniques
from edgevpr.core.config import Config, SalienceConfig
from edgevpr.core.contract import Technique
from edgevpr.core.errors import ConfigError, MapError, UsageError
from edgevpr.frames.mask import OverlayMask, load_mask
from edgevpr.frames.source import is_live
from edgevpr.places.index import load_index
from edgevpr.places.mapfile import PlaceMap
from edgevpr.places.sequence import compute_sequence_bytes, make_sequence_search
from edgevpr.power.boards import Board
from edgevpr.power.meter import QueryMeter
from edgevpr.runtime.recognise.calibration import read_calibration_for
from edgevpr.runtime.recognise.decide import Matcher, MatchSettings
from edgevpr.runtime.recognise.encoder import FrameEncoder
from edgevpr.runtime.recognise.evidence import list_evidence_kinds
from edgevpr.runtime.recognise.gate_networks import Detector, Memorability
from edgevpr.runtime.recognise.hints import Prior, RecordedPrior
from edgevpr.runtime.recognise.judge import make_accept_rule
from edgevpr.runtime.recognise.levelling import Levelling, make_levelling
from edgevpr.runtime.recognise.odometry import VisualOdometry
from edgevpr.runtime.recognise.place_filter import PlaceFilter
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.runtime.recognise.salience_gate import MAX_ENTROPY, SalienceGate
from edgevpr.techniques.card import load_card

_MAX_WAIT_S = 0.05  # longest wait in flight while another program writes to the map: queries must not be late
_log = logging.getLogger(__name__)
Settings = Mapping[str, int | float | str]  # parameters of a technique, by name


def open_recogniser(
    config: Config,
    board: Board,
    *,
    uses_hints: bool = False,
    known: Collection[str] = (),
    tracks_flight: bool = False,
    meter: QueryMeter | None = None,
) -> Recogniser:
    """Open the map, make its technique for the board (see `resolve_board`), and load the index.

    With `uses_hints`, for a flight, hints narrow each query (see `hints`); otherwise only the `known` data of recorded
    queries do (see `RecordedPrior`). With `tracks_flight`, the queries are those of one flight, in order (see
    `place_filter`). `meter` measures the queries (None: use the clocks of this computer). Raises an EdgevprError
    that explains the mismatch, such as a setting that the map was not built with."""
    if config.map is None:
        raise UsageError("There is no map to recognise places in: set one with --map, or `map:` in the configuration.")
    source, match = config.source, config.match
    place_map = PlaceMap.open(config.map)
    with ExitStack() as on_error:
        on_error.callback(place_map.close)
        settings_by_name = {"camera": source.camera, "matching": match.matching, "form": match.form}
        technique_settings = {name: value for name, value in settings_by_name.items() if value}
        technique = create_technique(place_map, config.technique, technique_settings, board)
        length = match.sequence or technique.spec.sequence
        index = load_index(place_map, technique, int(board.budget_mb * 1e6), compute_sequence_bytes(length))
        mask = load_mask(source.mask)
        warn_of_mismatch(place_map, mask, source.lens)
        levelling, gate = make_levelling(source, technique), open_salience_gate(config.salience, board.threads)
        knows_scale = isinstance(levelling, Levelling) and levelling.lens is not None
        prior = RecordedPrior(known, technique.spec.heading_within_deg)
        if uses_hints:
            prior = Prior(match.reach_m_s, technique.spec.heading_within_deg, is_live(source.uri))
        place_filter = None
        # Only matches with a confidence can be tracked, and only if no sequence is configured.
        if tracks_flight and match.sequence is None and list_evidence_kinds(technique.spec):
            place_filter = PlaceFilter(place_map, max_speed_m_s=match.reach_m_s, is_live=is_live(source.uri))
        rule = make_accept_rule(technique, match, length, read_calibration_for(place_map))
        candidates, min_accuracy_m = match.candidates or technique.candidates, config.mavlink.min_accuracy_m
        recogniser = Recogniser(
            FrameEncoder(technique=technique, levelling=levelling, mask=mask, gate=gate),
            place_map,
            Matcher(index, rule, make_sequence_search(length)),
            meter or QueryMeter(board, config.battery),
            settings=MatchSettings(candidates=candidates, min_accuracy_m=min_accuracy_m),
            odometry=VisualOdometry() if uses_hints and knows_scale else None,
            # In a sequence, a place that a wrong hint excluded from one query would count as compared and dissimilar.
            prior=prior if length == 1 else None,
            place_filter=place_filter,
        )
        if uses_hints:
            place_map.set_max_wait(_MAX_WAIT_S)
        on_error.pop_all()
    return recogniser


def open_salience_gate(config: SalienceConfig, threads: int = 1) -> SalienceGate | None:
    """Make the salience gate; None if the configuration does not enable it. A criterion without a network is off, with
    a warning. Raises ConfigError if nothing can pass or all criteria are off, ModelError for an unusable network."""
    if not config.use:
        return None
    if config.entropy > MAX_ENTROPY:
        raise ConfigError(
            f"`salience.entropy` is {config.entropy:g}, but must be at most {MAX_ENTROPY:.3f}, the highest possible."
        )
    memorability = detector = None
    if config.memorability > 0:
        if config.network:
            memorability = Memorability(load_card(config.network), threads)
        else:
            _log.warning("`salience.network` is not set: memorability is not checked")
    if config.staticity > 0:
        if config.detector:
            detector = Detector(load_card(config.detector), threads)
        else:
            _log.warning("`salience.detector` is not set: moving objects are not checked")
    if not (memorability or detector or config.entropy > 0):
        raise ConfigError("`salience.use` is true, but all criteria are off: raise a threshold or set `use` to false.")
    return SalienceGate(config, memorability, detector)


def make_technique(threads: int | None, name: str, settings: Settings | None = None) -> Technique:
    """Make the technique `name`; its network runs on `threads` threads (None: one) unless `settings` give a number."""
    defaults = {"threads": threads} if threads and "threads" in techniques.read_parameters(name) else {}
    return techniques.create(name, {**defaults, **(settings or {})})


def create_technique(
    place_map: PlaceMap, name: str | None = None, settings: Settings | None = None, board: Board | None = None
) -> Technique:
    """Make the technique that a map was built with, for `board`.

    Raises MapError if `name` or `settings` belong to another technique, UsageError for a setting that it lacks, and
    ModelError for an unusable network."""
    built_with, settings, threads = place_map.spec, settings or {}, board.threads if board else None
    if not techniques.is_known(built_with.name):
        raise MapError(
            f"{place_map.path} was built with `{built_with.name}`, which this version lacks: update edgevpr, "
            "copy its network and card to your models folder ($EDGEVPR_MODELS, else ~/.local/share/edgevpr/models), or "
            f"build the map with one of {', '.join(techniques.list_techniques())}."
        )
    if name in (None, built_with.name):
        try:
            technique = make_technique(threads, built_with.name, {**built_with.parameters, **settings})
        except (UsageError, TypeError, OverflowError) as error:
            if settings and isinstance(error, UsageError):
                raise
            raise MapError(
                f"{place_map.path}: its parameters are invalid ({error}): restore a backup or rebuild the map."
            ) from error
    else:
        technique = make_technique(threads, name, settings)
    place_map.require_technique(technique.spec)
    return technique


def warn_of_mismatch(place_map: PlaceMap, mask: OverlayMask | None, lens: str | None) -> None:
    """Warn if the places of a map, which remain usable, were built with another `mask`, or if their pictures were
    undistorted with a calibration and those of the queries will not be (`lens` None)."""
    if not len(place_map):
        return
    path, built_mask, built_lens = place_map.path, place_map.mask_sha256, place_map.lens
    if built_mask != (mask.sha256 if mask else None):
        how = "without a mask" if built_mask is None else "with another mask"
        _log.warning("%s was built %s: use the same mask for map and frames for better recognition", path, how)
    if built_lens and not lens:
        _log.warning(
            "%s was built with `source.lens` (%s): set `source.lens` to the calibration of this camera too, unless its "
            "lens has no distortion",
            path,
            built_lens,
        )
