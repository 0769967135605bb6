"""Images over HTTP that FFmpeg cannot read as a stream: the address of a single image, requested repeatedly
(`SnapshotCapture`), and a multipart stream whose parts are images of any type (`ResponseFile`)."""

import http.client
import re
import ssl
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import suppress
from urllib.parse import unquote, urlsplit

from edgevpr.core.errors import ImageError
from edgevpr.core.types import FRAME_TIME_SD_S
from edgevpr.frames.age import HIDDEN_DELAY_SD_S
from edgevpr.frames.depth import DepthRange
from edgevpr.frames.images import decode_image, encode_jpeg, is_whole_jpeg
from edgevpr.frames.shot import Capture, OpeningError, Refusal, Shot, make_thumbnail

_MAX_BYTES = 64_000_000  # of one image
_MAX_PART_S = 15.0  # for one image of a multipart stream: a slow sender must not block a thread for ever
_CHUNK_BYTES = 65536
_MAX_PERIOD_S = 1.0  # from one request for an image to the next
_JPEG_START = b"\xff\xd8"
_JPEG_END = b"\xff\xd9"
_REQUEST_ERRORS = (OSError, http.client.HTTPException, ValueError)


def send_request(uri: str, timeout_s: float) -> http.client.HTTPResponse:
    """Request the http or https address `uri`, which may contain user and password, and return the response.
    `timeout_s` limits each wait. Raises one of `_REQUEST_ERRORS`."""
    parts = urlsplit(uri)
    account, _, host = parts.netloc.rpartition("@")
    address = parts._replace(netloc=host).geturl()
    user, _, password = account.partition(":")
    passwords = urllib.request.HTTPPasswordMgrWithDefaultRealm()
    passwords.add_password(None, address, unquote(user), unquote(password))
    context = ssl.create_default_context()
    context.check_hostname = False  # cameras use self-signed certificates; FFmpeg does not check them either
    context.verify_mode = ssl.CERT_NONE
    opener = urllib.request.build_opener(
        urllib.request.ProxyHandler({}),
        urllib.request.HTTPSHandler(context=context),
        urllib.request.HTTPDigestAuthHandler(passwords),
        urllib.request.HTTPBasicAuthHandler(passwords),
    )
    response: http.client.HTTPResponse = opener.open(address, timeout=timeout_s)
    return response


def try_request(uri: str, timeout_s: float) -> http.client.HTTPResponse | None:
    """Request `uri`; return None if that fails for a reason that FFmpeg will report. Raises OpeningError on timeout."""
    try:
        return send_request(uri, timeout_s)
    except _REQUEST_ERRORS as error:
        if isinstance(getattr(error, "reason", error), TimeoutError):
            raise OpeningError(f"no answer within {timeout_s:g} s") from None
    return None


class SnapshotCapture(Capture):
    """Requests the image at `uri` every `period_s` seconds; each request takes a few seconds at most. Its capture time
    is that of the request, when most cameras take it. A camera that returned the same file twice keeps an image ready,
    which may be as old as the previous request."""

    def __init__(
        self, uri: str, period_s: float, timeout_s: float, clock: Callable[[], float], *, upright: bool = True
    ) -> None:
        self._uri, self._timeout_s, self._clock, self._upright = uri, timeout_s, clock, upright
        self._period_s = min(period_s, _MAX_PERIOD_S)
        self._next_request_s = self._request_s = clock()
        self._data, self._is_buffered, self._depth = b"", False, DepthRange()

    def read(self) -> Shot | Refusal | None:
        time.sleep(max(0.0, self._next_request_s - self._clock()))
        last_request_s, self._request_s = self._request_s, self._clock()
        self._next_request_s = self._request_s + self._period_s
        try:
            with send_request(self._uri, self._timeout_s) as response:
                data = response.read(_MAX_BYTES)
            arrival_s = self._clock()
            image = decode_image(data, "the snapshot", self._depth, upright=self._upright)
        except ImageError:
            return Refusal.DAMAGED
        except _REQUEST_ERRORS:
            return None
        self._is_buffered = self._is_buffered or data == self._data
        self._data = data
        plane = image if image.ndim == 2 else image[:, :, 1]
        taken_s = last_request_s if self._is_buffered else self._request_s
        sd_s = max(FRAME_TIME_SD_S, self._period_s if self._is_buffered else arrival_s - self._request_s)
        times = {"t_mono_s": taken_s, "t_sd_s": sd_s, "delay_sd_s": HIDDEN_DELAY_SD_S}
        return Shot(thumbnail=make_thumbnail(plane), convert=lambda: image, **times)


class ResponseFile:
    """The body of a `response` as a file that returns bytes as soon as they arrive; with `is_multipart` each part
    becomes an image/jpeg, which FFmpeg can read. The file ends if the connection is lost."""

    def __init__(self, response: http.client.HTTPResponse, is_multipart: bool) -> None:
        self._pieces, self._unread = (_read_parts if is_multipart else _read_chunks)(response), b""
        self.close = response.close

    def read(self, size: int = -1) -> bytes:
        """Return the next bytes, at most `size`."""
        self._unread = self._unread or next(self._pieces, b"")
        data, self._unread = self._unread[:size], self._unread[size:]
        return data


def _read_chunks(response: http.client.HTTPResponse) -> Iterator[bytes]:
    with suppress(*_REQUEST_ERRORS):
        while chunk := response.read1(_CHUNK_BYTES):
            yield chunk


def _read_parts(response: http.client.HTTPResponse) -> Iterator[bytes]:
    boundary = re.escape((response.headers.get_boundary() or "").strip('-" ').encode("latin-1", "replace"))
    headers = re.compile(boundary + rb"[^\n]*\n((?:[^\r\n]+\r?\n)*)\r?\n")
    received, last_part_s = bytearray(), time.monotonic()
    for chunk in _read_chunks(response):
        received += chunk
        while (part := headers.search(received)) and (end := _find_end(received, part, boundary)):
            data = bytes(received[part.end() : end])
            del received[:end]
            last_part_s = time.monotonic()
            with suppress(ImageError):
                jpeg = data if data.startswith(_JPEG_START) else encode_jpeg(decode_image(data, "the part"))
                yield b"--part\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n%b\r\n" % (len(jpeg), jpeg)
        if len(received) > _MAX_BYTES or time.monotonic() > last_part_s + _MAX_PART_S:
            return


def _find_end(received: bytearray, part: re.Match[bytes], boundary: bytes) -> int:
    """Return the end of the image that begins after the headers of a `part`; 0 if it has not arrived. Without a stated
    length, a JPEG ends at its end marker. FFmpeg would wait for the next part: one frame period more delay."""
    start = part.end()
    if length := re.search(rb"(?im)^content-length:\s*(\d+)", part[1]):
        end = start + int(length[1])
        return end if end <= len(received) else 0
    end = start
    while received.startswith(_JPEG_START, start) and (end := received.find(_JPEG_END, end) + 2) >= 2:
        if is_whole_jpeg(bytes(received[start:end])):
            return end
    next_part = re.search(rb"\r?\n--" + boundary, received[start:])
    return start + next_part.start() if next_part else 0
