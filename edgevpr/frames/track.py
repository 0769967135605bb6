"""Positions of a video: a table says where it was at which second, and a frame between two lines lies between them."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from edgevpr.core.errors import UsageError
from edgevpr.core.types import Position
from edgevpr.frames.positions import GeoTag, rows_of, tag_of

NEEDED_COLUMNS = ("time", "lat", "lon")
MOST_GAP_S = 5.0  # a straight line between fixes that lie further apart says where nobody was
_ROUNDING_S = 0.001  # Matroska counts in milliseconds


@dataclass(frozen=True, slots=True)
class Track:
    """The path of a video: the seconds from its first frame, ascending, and the tag at each. `path` is the file of
    it."""

    path: Path
    t_s: tuple[float, ...]
    tags: tuple[GeoTag, ...]

    def tag_at(self, t_s: float) -> GeoTag:
        """Return position, attitude and height at a second of the video, on the straight line between the two lines
        around it. The tag is empty outside the table, and where these are more than `MOST_GAP_S` apart."""
        nearest = int(np.abs(np.subtract(self.t_s, t_s)).argmin())
        if abs(self.t_s[nearest] - t_s) <= _ROUNDING_S:
            return self.tags[nearest]
        after = int(np.searchsorted(self.t_s, t_s))
        if not 0 < after < len(self.t_s) or self.t_s[after] - self.t_s[after - 1] > MOST_GAP_S:
            return GeoTag()
        one, other = self.tags[after - 1], self.tags[after]
        share = (t_s - self.t_s[after - 1]) / (self.t_s[after] - self.t_s[after - 1])
        heading_deg = _turned(one.heading_deg, other.heading_deg, share)
        return GeoTag(
            position=_position(one.position, other.position, share),
            heading_deg=None if heading_deg is None else heading_deg % 360,
            roll_deg=_turned(one.roll_deg, other.roll_deg, share),
            pitch_deg=_between(one.pitch_deg, other.pitch_deg, share),
            height_m=_between(one.height_m, other.height_m, share),
        )

    def require_within(self, video: Path, lasts_s: float) -> None:
        """Raise UsageError where no line of the table is of a second of the video, nor two around it."""
        if self.t_s[-1] < -_ROUNDING_S or self.t_s[0] > lasts_s:
            raise UsageError(
                f"{self.path} has positions from {self.t_s[0]:.1f} to {self.t_s[-1]:.1f} s, and {video} lasts from 0 "
                f"to {lasts_s:.1f} s: write `time` in seconds from its first frame."
            )


def read_track(csv_path: str | Path) -> Track:
    """Read the positions of a video: the columns time (seconds from its first frame, ascending), lat, lon and, where
    present, those of a positions.csv. A line without a position says nothing. Raises UsageError for a file that cannot
    be read, a wrong value, and one without any position."""
    times_s: list[float] = []
    tags: list[GeoTag] = []
    for where, row in rows_of(csv_path, NEEDED_COLUMNS):
        tag = tag_of(row, where)
        if tag.position is None:
            continue
        if tag.t_utc_s is None:
            raise UsageError(f"{where} has no time: write the seconds from the first frame of the video.")
        if times_s and tag.t_utc_s <= times_s[-1]:
            raise UsageError(f"{where}: time is not after that of the line before: sort the lines, one for each time.")
        times_s.append(tag.t_utc_s)
        tags.append(replace(tag, t_utc_s=None))
    if not tags:
        raise UsageError(f"{csv_path} has no line with time, lat and lon: the positions of a video need them.")
    return Track(Path(csv_path), tuple(times_s), tuple(tags))


def _position(one: Position, other: Position, share: float) -> Position:
    lon_deg = (_turned(one.lon_deg, other.lon_deg, share) + 180) % 360 - 180
    return Position(_between(one.lat_deg, other.lat_deg, share), lon_deg, _between(one.alt_m, other.alt_m, share))


def _between(one: float | None, other: float | None, share: float) -> float | None:
    return None if one is None or other is None else one + share * (other - one)


def _turned(one_deg: float | None, other_deg: float | None, share: float) -> float | None:
    """Turn the shorter way from one angle to the other."""
    if one_deg is None or other_deg is None:
        return None
    return one_deg + share * ((other_deg - one_deg + 180) % 360 - 180)
