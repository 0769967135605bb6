"""The causes why FFmpeg cannot open a stream, in a few words. None contains the address, which may hold a password."""

import errno
import re
from urllib.parse import urlsplit

import av

from edgevpr.frames.shot import OpeningError

_UNKNOWN_HOST = re.compile(r"(?:resolve hostname |getaddrinfo\()([^\s:,]+)")
_STATUS = re.compile(r"(?:failed:|HTTP error) ([45]\d\d)\b")  # of RTSP and of HTTP
_BY_ERROR = {
    errno.ECONNREFUSED: "connection refused",
    errno.ECONNRESET: "connection closed by the camera",
    errno.EHOSTUNREACH: "no route to the host",
    errno.ENETUNREACH: "no route to the host",
    errno.EINVAL: "an address that cannot be used: correct host and port",
    errno.EADDRINUSE: "UDP port in use by another program",
}


class TransportError(OpeningError):
    """The camera refuses the transport that was requested for RTSP."""


def explain_failure(uri: str, error: Exception, messages: list[str], timeout_s: float) -> OpeningError:
    """Return the error with the cause why FFmpeg could not open `uri` in `timeout_s` seconds. `messages`: what FFmpeg
    logged meanwhile; some causes are found only there."""
    text = "\n".join(messages)
    if host := _UNKNOWN_HOST.search(text):
        if uri.count("@") > 1:  # then the host may be a part of the password
            return OpeningError("no such host: percent-encode the password's special characters, such as @ as %40")
        return OpeningError(f"no such host {host[1]}")
    if "SETUP failed: 461" in text or "Nonmatching transport" in text:
        return TransportError("transport refused (461)")
    if isinstance(error, (av.HTTPClientError, av.HTTPServerError)):
        return OpeningError(_explain_status(uri, error, text))
    number = errno.EADDRINUSE if "Address already in use" in text else getattr(error, "errno", 0)
    if number in _BY_ERROR:
        return OpeningError(_BY_ERROR[number])
    if isinstance(error, av.ExitError) or "Immediate exit" in text or number == errno.ETIMEDOUT:
        missing = "video in the packets" if uri.lower().startswith(("udp:", "rtp:")) else "answer"
        return OpeningError(f"no {missing} within {timeout_s:g} s")
    if isinstance(error, av.InvalidDataError):
        closed = "End of file" in text
        return OpeningError("connection closed by the camera" if closed else "no video that FFmpeg can read")
    return OpeningError(getattr(error, "strerror", None) or type(error).__name__)


def _explain_status(uri: str, error: Exception, text: str) -> str:
    if isinstance(error, av.HTTPUnauthorizedError):
        if "@" not in urlsplit(uri).netloc:
            return "password needed (401): write USER:PASSWORD@ before the host"
        return "password refused (401): correct it, with special characters percent-encoded, such as % as %25"
    if isinstance(error, av.HTTPForbiddenError):
        return "access forbidden (403)"
    if isinstance(error, av.HTTPNotFoundError):
        return "no stream at this path (404)"
    status = _STATUS.search(text)
    return f"refused by the camera ({status[1]})" if status else "refused by the camera"
