"""Pictures over HTTP that FFmpeg does not read as a stream: an address of one picture, requested again and again
(`Snapshots`), and a multipart stream whose parts are not called image/jpeg (`PartsFile`)."""

import http.client
import ssl
import time
import urllib.request
from collections.abc import Callable
from contextlib import suppress
from urllib.parse import unquote, urlsplit

from edgevpr.core.errors import ImageError
from edgevpr.core.types import FRAME_TIME_SD_S
from edgevpr.frames.depth import DepthRange
from edgevpr.frames.images import as_jpeg, decode_image, jpeg_is_whole
from edgevpr.frames.shot import OpeningError, Refusal, Shot, coarse

_MAX_BYTES = 64_000_000  # of one picture
_CHUNK_BYTES = 65536
_MAX_PERIOD_S = 1.0  # from one request for a picture to the next
_JPEG_START = b"\xff\xd8"
_JPEG_END = b"\xff\xd9"
_FAILURES = (OSError, http.client.HTTPException, ValueError)


class Request:
    """The answer to a request for `uri`, http or https. `timeout_s` limits each wait, and each `take`."""

    def __init__(self, uri: str, timeout_s: float) -> None:
        parts = urlsplit(uri)
        account, _, host = parts.netloc.rpartition("@")
        address = parts._replace(netloc=host).geturl()
        user, _, password = account.partition(":")
        passwords = urllib.request.HTTPPasswordMgrWithDefaultRealm()
        passwords.add_password(None, address, unquote(user), unquote(password))
        context = ssl.create_default_context()
        context.check_hostname = False  # cameras sign their certificates themselves; FFmpeg does not check them either
        context.verify_mode = ssl.CERT_NONE
        opener = urllib.request.build_opener(
            urllib.request.ProxyHandler({}),
            urllib.request.HTTPSHandler(context=context),
            urllib.request.HTTPDigestAuthHandler(passwords),
            urllib.request.HTTPBasicAuthHandler(passwords),
        )
        self._timeout_s, self._buffer = timeout_s, bytearray()
        self._answer: http.client.HTTPResponse = opener.open(address, timeout=timeout_s)
        self.headers = self._answer.headers

    def read(self, size: int = -1) -> bytes:
        """Return the next bytes, at most `size`; none if the connection is lost."""
        with suppress(*_FAILURES):
            return self.take(lambda seen: min(size, len(seen)))
        return b""

    def take(self, find_end: Callable[[bytearray], int] | None = None) -> bytes:
        """Read as many bytes of those that have come as `find_end` says (0: more are needed), or all. Raises OSError if
        the answer ends before, and if that is too much or takes too long."""
        end_s = time.monotonic() + self._timeout_s
        while not (count := find_end(self._buffer) if find_end else 0):
            chunk = self._answer.read1(_CHUNK_BYTES)
            self._buffer += chunk
            if not chunk and not find_end:
                return bytes(self._buffer)
            if not chunk or len(self._buffer) > _MAX_BYTES or time.monotonic() > end_s:
                raise OSError("the answer is cut short, too large or too slow")
        data = bytes(self._buffer[:count])
        del self._buffer[:count]
        return data

    def close(self) -> None:
        """Close the connection."""
        self._answer.close()


class Snapshots:
    """A `Capture` that requests the picture at `uri` every `period_s` seconds. Its time is that of the request, as most
    cameras take it then. One that gave the same file twice keeps a picture ready, which may be as old as the request
    before."""

    def __init__(self, uri: str, period_s: float, timeout_s: float, clock: Callable[[], float]) -> None:
        self._uri, self._timeout_s, self._clock = uri, timeout_s, clock
        self._period_s = min(period_s, _MAX_PERIOD_S)
        self._due_s = self._asked_s = clock()
        self._data, self._is_kept, self._depth = b"", False, DepthRange()

    def read(self) -> Shot | Refusal | None:
        time.sleep(max(0.0, self._due_s - self._clock()))
        before_s, self._asked_s = self._asked_s, self._clock()
        self._due_s = self._asked_s + self._period_s
        try:
            request = Request(self._uri, self._timeout_s)
            data = request.take(None)
            answered_s = self._clock()
            request.close()
            image = decode_image(data, "the snapshot", self._depth)
        except ImageError:
            return Refusal.DAMAGED
        except _FAILURES:
            return None
        self._is_kept = self._is_kept or data == self._data
        self._data = data
        plane = image if image.ndim == 2 else image[:, :, 1]
        taken_s = before_s if self._is_kept else self._asked_s
        sd_s = max(FRAME_TIME_SD_S, self._period_s if self._is_kept else answered_s - self._asked_s)
        return Shot(t_mono_s=taken_s, t_sd_s=sd_s, look=coarse(plane), pixels=lambda: image)

    def cancel(self) -> None:
        """Do nothing: a request lasts a few seconds at most."""

    def release(self) -> None:
        """Do nothing: no connection is open between two requests."""


class PartsFile:
    """A file of a multipart stream that FFmpeg can read: each part of `request` becomes an image/jpeg."""

    def __init__(self, request: Request) -> None:
        self._request, self._unread = request, b""
        self._boundary = (request.headers.get_boundary() or "").strip('-" ').encode("latin-1", "replace")

    def read(self, size: int = -1) -> bytes:
        """Return the next bytes, at most `size`; none if the stream is lost."""
        try:
            while not self._unread:
                self._unread = self._next_part()
        except _FAILURES:
            return b""
        data, self._unread = self._unread[:size], self._unread[size:]
        return data

    def _next_part(self) -> bytes:
        self._request.take(lambda seen: seen.find(b"\n", at) + 1 if (at := seen.find(self._boundary)) >= 0 else 0)
        length = 0
        while line := self._request.take(lambda seen: seen.find(b"\n") + 1).strip():
            name, _, value = line.partition(b":")
            if name.strip().lower() == b"content-length":
                length = max(0, int(value))
        data = self._request.take(lambda seen: length * (len(seen) >= length) if length else self._find_end(seen))
        if not data.startswith(_JPEG_START):
            try:
                data = as_jpeg(decode_image(data, "the part"))
            except ImageError:
                return b""
        return b"--part\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%b\r\n" % (len(data), data)

    def _find_end(self, seen: bytearray) -> int:
        """Return the number of bytes of a picture without a stated length, 0 if its end has not come. A JPEG ends with
        its end mark. FFmpeg waits for the next part instead, which makes each picture a whole period older."""
        end = 0
        while seen.startswith(_JPEG_START) and (end := seen.find(_JPEG_END, end) + 2) >= 2:
            if jpeg_is_whole(bytes(seen[:end])):
                return end
        return max(0, seen.find(b"\n--" + self._boundary))


def open_request(uri: str, timeout_s: float) -> Request | None:
    """Request `uri`; None if that fails, for a cause that FFmpeg can find. Raises OpeningError if nothing answers."""
    try:
        return Request(uri, timeout_s)
    except _FAILURES as error:
        if isinstance(getattr(error, "reason", error), TimeoutError):
            raise OpeningError(f"no answer within {timeout_s:g} s") from None
    return None
