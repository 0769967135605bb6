"""Flies over a folder of tiles: keeps in RAM those around the aircraft, which a thread loads beside the queries.

As long as it is known about where the aircraft is, by GPS or by what was recognised, the tiles there are searched, and
those next to them, or ahead, are loaded before they are needed. Otherwise the aircraft is *lost*: tiles are loaded in
turn, all of the folder, and each query searches one of them and is judged by itself. Where nothing has been recognised
for a minute, GPS may be wrong: from then on every second minute counts as lost.
"""

from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from edgevpr.core.arrays import Doubles
from edgevpr.core.config import MatchConfig
from edgevpr.core.errors import MapError
from edgevpr.core.geodesy import moved
from edgevpr.core.types import Position, Tape
from edgevpr.mavlink.messages import Severity
from edgevpr.places.layers import layers_of
from edgevpr.places.tilemap import Loaded, TileMap, tile_of_place
from edgevpr.runtime.flight.notifier import Notifier
from edgevpr.runtime.recognise.decide import Matcher
from edgevpr.runtime.recognise.evidence import read_calibration_for
from edgevpr.runtime.recognise.hints import RECORDED_REACH_M, Reach
from edgevpr.runtime.recognise.judge import AcceptRule, accept_rule
from edgevpr.runtime.recognise.recogniser import Recogniser
from edgevpr.runtime.recognise.recognition import Recognition

_LOST_S = 60.0
_AHEAD_S = 60.0  # the tiles at which the aircraft then is are loaded as soon as those where it is
_BESIDE_M = (
    RECORDED_REACH_M  # beyond the area, in which the aircraft may be nevertheless: what lies there is searched too
)
_HELD_NEARER = 0.25  # by this share of its side a tile in RAM counts as nearer: two must not take turns at an edge


class Tiles:
    """The tiles of a flight over `tile_map`, of which one is in RAM and searched by the `recogniser`. Give every event
    to `update`, and `close` it before the map."""

    def __init__(
        self, tile_map: TileMap, recogniser: Recogniser, match: MatchConfig, *, notifier: Notifier, tape: Tape
    ) -> None:
        self._map, self._recogniser, self._match, self._notifier, self._tape = (
            tile_map,
            recogniser,
            match,
            notifier,
            tape,
        )
        self._thread = ThreadPoolExecutor(1, "tiles")
        self._loading: tuple[int, Future[tuple[Loaded, AcceptRule]]] | None = None
        self._rules = dict.fromkeys(tile_map.ram.tiles, recogniser.rule)
        self._unusable: set[int] = set()
        self._searched_s = np.full(len(tile_map.keys), -np.inf)  # when each was searched last, while lost
        self._searched: tuple[int, ...] = tile_map.ram.tiles
        self._area: Reach | None = None  # the last that was known
        self._found_s: float | None = None
        self._layers = layers_of(tile_map)
        self._note_held()

    def update(self, event: Recognition) -> None:
        """Load, drop and search tiles by what an event says of the aircraft's position."""
        if event.frame is None:
            return
        now_s, before = event.frame.t_mono_s, (self._searched, self._map.ram.tiles)
        if event.ranking is not None:
            self._searched_s[list(self._searched)] = now_s
        area = self._known(event, now_s)
        self._take_loaded()
        if area:
            self._go_to(self._wanted(area, event))
            self._searched = self._near(area)
        else:
            self._look_elsewhere()
            self._searched = tuple(sorted(self._map.ram.tiles, key=lambda tile: self._searched_s[tile])[:1])
        if (self._searched, self._map.ram.tiles) != before:
            self._search(held_before=before[1], is_lost=area is None)

    def close(self) -> None:
        """End the thread; what it is loading is given up."""
        self._map.interrupt()
        self._thread.shutdown()
        if self._loading and not self._loading[1].exception():
            self._loading[1].result()[0].place_map.close()

    def _known(self, event: Recognition, now_s: float) -> Reach | None:
        """Return where the aircraft is; None if it is lost."""
        area = self._recogniser.area
        if event.accepted and event.located:
            self._found_s, area = now_s, Reach(event.located.position, event.accuracy_m or 0.0)
        self._area = area or self._area
        self._found_s = now_s if self._found_s is None else self._found_s
        return None if (now_s - self._found_s) // _LOST_S % 2 else area

    def _wanted(self, area: Reach, event: Recognition) -> list[int]:
        """Return the tiles to have in RAM, the most urgent first."""
        away_m = self._map.away_m(area.position)
        if event.vehicle and event.vehicle.velocity_m_s:
            east_m, north_m = (_AHEAD_S * speed_m_s for speed_m_s in event.vehicle.velocity_m_s)
            ahead = Position(*moved(area.position.lat_deg, area.position.lon_deg, east_m, north_m))
            away_m = np.minimum(away_m, self._map.away_m(ahead))
        side_m = self._map.side_m(int(away_m.argmin()))
        away_m[list(self._map.ram.tiles)] -= _HELD_NEARER * side_m
        wanted, room = list[int](), self._map.ram.capacity
        for tile in np.argsort(away_m, kind="stable").tolist():
            if tile in self._unusable:
                continue
            room -= self._places(tile)
            if away_m[tile] > area.radius_m + side_m or room < 0:
                break
            wanted.append(tile)
        return wanted

    def _near(self, area: Reach) -> tuple[int, ...]:
        """Return the tiles in RAM in which the aircraft can be, or the nearest of them; those searched before stay a
        little longer."""
        away_m, held = self._map.away_m(area.position), self._map.ram.tiles
        most_m = {tile: area.radius_m + _BESIDE_M * (2 if tile in self._searched else 1) for tile in held}
        near = tuple(tile for tile in held if away_m[tile] <= most_m[tile])
        return near or tuple(sorted(held, key=lambda tile: away_m[tile])[:1])

    def _places(self, tile: int) -> int:
        return min(int(self._map.places_of[tile]), self._map.ram.capacity)

    def _go_to(self, wanted: list[int]) -> None:
        """Have the tiles `wanted` in RAM, and no others."""
        if self._loading or not wanted:
            return
        to_load = next((tile for tile in wanted if tile not in self._map.ram.tiles), None)
        for tile in set(self._map.ram.tiles) - set(wanted):
            self._map.drop(tile)
        if to_load is not None:
            self._load(to_load)

    def _look_elsewhere(self) -> None:
        """Load the tile that was searched the longest ago, in place of one that was searched just now."""
        others = [tile for tile in range(len(self._searched_s)) if tile not in {*self._map.ram.tiles, *self._unusable}]
        if self._loading or not others:
            return
        away_m: Doubles = np.arange(float(len(self._searched_s)))
        if self._area:
            away_m = self._map.away_m(self._area.position)
        to_load = min(others, key=lambda tile: (self._searched_s[tile], away_m[tile]))
        for tile in sorted(self._map.ram.tiles, key=lambda tile: self._searched_s[tile]):
            if self._map.ram.free < self._places(to_load) and self._searched_s[tile] > self._searched_s[to_load]:
                self._map.drop(tile)
        if self._map.ram.free >= self._places(to_load):
            self._load(to_load)

    def _load(self, tile: int) -> None:
        self._loading = tile, self._thread.submit(self._loaded, tile)

    def _loaded(self, tile: int) -> tuple[Loaded, AcceptRule]:
        """Read a tile, beside the queries."""
        loaded = self._map.load(tile)
        calibration = read_calibration_for(loaded.place_map)
        return loaded, accept_rule(self._recogniser.technique, self._match, calibration=calibration)

    def _take_loaded(self) -> None:
        """Search the tile that has been loaded, if it is ready. A replay waits for it where the flight had it."""
        if self._loading is None or not self._tape.read("tile", self._loading[1].done):
            return
        (tile, future), self._loading = self._loading, None
        try:
            loaded, self._rules[tile] = future.result()
        except MapError as error:
            self._unusable.add(tile)
            ground = "a tile of the map cannot be used, see its log"
            self._notifier.report("tile", Severity.WARNING, str(error), ground=ground, problem=str(error))
        else:
            self._map.take(loaded)

    def _search(self, held_before: tuple[int, ...], is_lost: bool) -> None:
        """Have the recogniser search the tiles that are to be searched."""
        held = self._map.ram.tiles
        if held != held_before:
            if held:
                self._layers = layers_of(self._map)
            self._note_held()
        rules = {tile: self._rules[tile] for tile in held}
        self._recogniser.change(
            matcher=Matcher(
                self._map.ram.of(self._searched),
                rules[self._searched[0]] if self._searched else self._recogniser.rule,
                layers=self._layers,
                rule_of=lambda place_id: rules[tile_of_place(place_id)],
                follows=not is_lost,
            )
        )

    def _note_held(self) -> None:
        self._notifier.log("tiles", held=[self._map.keys[tile] for tile in self._map.ram.tiles])


def open_tiles(recogniser: Recogniser, match: MatchConfig, notifier: Notifier, tape: Tape) -> Tiles | None:
    """Return the tiles of a recogniser's map; None if it is a single map."""
    if not isinstance(recogniser.place_map, TileMap):
        return None
    return Tiles(recogniser.place_map, recogniser, match, notifier=notifier, tape=tape)
