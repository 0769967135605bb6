"""A video file as a source of frames. It is read in order to its end; damaged and missing parts are reported."""

import math
from collections import deque
from collections.abc import Callable, Collection
from contextlib import suppress
from pathlib import Path

from av.video.frame import VideoFrame

from edgevpr.core.errors import ImageError, SourceError
from edgevpr.core.types import Frame
from edgevpr.frames.decoding import VideoDecoder, open_decoder
from edgevpr.frames.positions import GeoTag, Track, parse_time
from edgevpr.frames.shot import OpeningError, Refusal
from edgevpr.frames.source import RecordingSource, make_frame

_TIMESTAMP_ROUNDING_S = 0.001  # Matroska stores milliseconds
_DEFAULT_RATE_HZ = 25.0
_MAX_MISSING_S = 1.0  # at the end, not reported: other streams in the file may be longer


def read_start_s(path: Path) -> tuple[float | None, float]:
    """Return the start of a video, in seconds since 1970 on the camera's clock (None: unknown), and its duration in
    seconds (0: unknown). Raises SourceError for a file that is not a video."""
    decoder = _open_video(path, "the video file of the positions")
    start = {**decoder.container.metadata, **decoder.stream.metadata}.get("creation_time")
    duration_s = (decoder.container.duration or 0) / 1e6
    decoder.close()
    with suppress(ValueError, OverflowError):
        return (parse_time(start) if start else None), duration_s
    return None, duration_s


def _open_video(path: Path, advice: str) -> VideoDecoder:
    try:
        return open_decoder(str(path), {})
    except OpeningError:
        raise SourceError(f"{path} is not a video that can be decoded: use {advice}.") from None


class VideoSource(RecordingSource):
    """The frames of the video file `path`, at least `step_s` seconds of video time apart (0: every frame); every run
    returns the same frames. `track`: positions of the frames (None: unknown).

    Damaged frames, and frames decoded from them, are skipped: `read` raises ImageError once for each sequence of them,
    and once if the end of the file is missing."""

    def __init__(
        self, path: Path, step_s: float, clock: Callable[[], float], only: Collection[str] | None, track: Track | None
    ):
        super().__init__(only)
        self._path, self._step_s, self._clock, self._track = path, step_s, clock, track
        self._decoder = decoder = _open_video(path, "a video file or a folder of images")
        stream = decoder.stream
        self._first_stamp = stream.start_time or 0
        self._frame_s = 1 / float(stream.average_rate or _DEFAULT_RATE_HZ)
        duration_s = stream.duration * decoder.unit_s if stream.duration else (decoder.container.duration or 0) / 1e6
        stated_s = duration_s if decoder.is_stamped else 0.0
        frames = stream.frames or stated_s / self._frame_s
        self._expected_s = max(stated_s, stream.frames * self._frame_s)  # in a truncated AVI only the latter is right
        self.total = math.ceil(frames * self._frame_s / max(step_s, self._frame_s))
        if track and self._expected_s:
            track.require_overlap(path, self._expected_s)
        self._ready: deque[VideoFrame] = deque()
        self._index, self._damaged_count = -1, 0
        self._t_s = -self._frame_s
        self._t_due_s = self._read_s = 0.0

    def read(self, timeout_s: float) -> Frame | None:
        deadline_s = self._clock() + timeout_s
        while not self.ended:
            if not self._ready:
                self._decode_more()
            elif self._damaged_count:
                self._report_damage()
            elif self._advance(picture := self._ready.popleft()):
                self._t_due_s = self._t_s + self._step_s
                name = f"frame {self._index:06d} t={self._t_s:.3f} s"
                if self.is_selected(name):
                    tag = self._track.interpolate_tag(self._t_s) if self._track else GeoTag()
                    image = self.stereo.refuse_stereo(self._decoder.prepare_conversion(picture)())
                    return make_frame(image, name, self._clock(), tag)
            if self._clock() >= deadline_s:
                break
        return None

    def close(self) -> None:
        self.end()
        self._decoder.close()

    def _decode_more(self) -> None:
        fetched = self._decoder.fetch()
        if fetched is None:
            self._finish()
            return
        if fetched.packet.pts is not None:
            self._read_s = max(self._read_s, (fetched.packet.pts - self._first_stamp) * self._decoder.unit_s)
        pictures = self._decoder.decode(fetched)
        if isinstance(pictures, Refusal):
            self._damaged_count += 1
        else:
            self._ready.extend(pictures)

    def _advance(self, picture: VideoFrame) -> bool:
        """Advance index and video time to `picture`, the next one decoded; return True if it should be returned."""
        self._index += 1
        stamp_s = ((picture.pts or 0) - self._first_stamp) * self._decoder.unit_s
        # Without usable timestamps, as in a raw H.264 or MJPEG file, the frame rate is used.
        self._t_s = stamp_s if stamp_s > self._t_s else self._t_s + self._frame_s
        return self._t_s >= self._t_due_s - _TIMESTAMP_ROUNDING_S

    def _report_damage(self, suffix: str = "") -> None:
        count, first, t_s = self._damaged_count, self._index + 1, self._t_s + self._frame_s
        self.refused[Refusal.DAMAGED.value] += count
        self._damaged_count, self._index = 0, self._index + count
        self._t_s += 0.0 if self._decoder.is_stamped else count * self._frame_s
        frames = f"frame {first:06d} (t={t_s:.1f} s)" + (f" and {count - 1} after it" if count > 1 else "")
        raise ImageError(
            f"{self._path}: {frames} cannot be used{suffix} (damaged, or dependent on damaged frames): "
            "copy the video again.",
            count,
        )

    def _finish(self) -> None:
        if self._damaged_count:
            self._report_damage(suffix=" up to the end of the file")
        self.end()
        missing_s = self._expected_s - self._read_s - self._frame_s
        if missing_s > _MAX_MISSING_S:
            raise ImageError(
                f"{self._path} is truncated ({self._expected_s - missing_s:.1f} s of {self._expected_s:.1f} s): copy "
                "the video again.",
                round(missing_s / self._frame_s),
            )
