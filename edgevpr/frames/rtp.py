"""RTP (RFC 3550) sent to a UDP port without a description, as many companion computers and ground stations do. FFmpeg
needs an SDP (RFC 8866) that names the codec; this module makes one from the first packets."""

import base64
import errno
import re
import socket
import time
from collections import Counter
from contextlib import suppress
from urllib.parse import urlsplit

from edgevpr.frames.shot import OpeningError

_VERSION_2 = 0x80  # the two highest bits of an RTP packet
_HEADER_BYTES = 12
_MAX_PACKETS = 10  # to identify the codec; most are fragments, which cannot be mistaken for other codecs' packets
_STATIC_TYPES = {26: "JPEG", 32: "MPV", 33: "MP2T"}  # payload types of RFC 3551
_FIRST_DYNAMIC_TYPE = 96
_H264_TYPES = (1, 5, 6, 7, 8, 9, 24, 28)  # NAL units, aggregates and fragments (RFC 6184)
_H265_TYPES = (0, 1, 19, 20, 21, 32, 33, 34, 35, 39, 48, 49)  # the same (RFC 7798)
_MULTICAST_OR_IPV6 = re.compile(r"\w+://@?(2(2[4-9]|3\d)\.|\[)")  # FFmpeg receives these itself


def describe_rtp(uri: str, timeout_s: float) -> str | None:
    """Wait for packets at `uri`, udp://[HOST]:PORT or rtp://[HOST]:PORT. Returns the address of an SDP that describes
    them if they are RTP, otherwise None: FFmpeg may recognise them. Raises OpeningError if no packet arrives, if the
    port is in use, or if the codec is not H.264, H.265, JPEG, MPEG-2 or MPEG-TS."""
    if _MULTICAST_OR_IPV6.match(uri):
        return None
    try:
        port = urlsplit(uri).port or 0
    except ValueError:
        raise OpeningError("the address must contain host and port") from None
    with _open_port(port) as receiver:
        packets = _receive_packets(receiver, timeout_s)
    if not packets and "?" in uri:  # FFmpeg may know from the options how to receive them
        return None
    if not packets:
        raise OpeningError(f"no packet at UDP port {port} within {timeout_s:g} s")
    if not all(map(_is_rtp, packets)):
        return None
    codecs = Counter(codec for codec in map(_find_codec, packets) if codec)
    if not codecs:
        payload_type = packets[0][1] & 0x7F
        raise OpeningError(f"RTP with an unknown codec (payload type {payload_type}): describe it in an .sdp file")
    _open_port(port + 1).close()  # FFmpeg would not release the first port if the second were in use
    (payload_type, codec), _ = codecs.most_common(1)[0]
    sdp = (
        "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=camera\nc=IN IP4 0.0.0.0\nt=0 0\n"
        f"m=video {port} RTP/AVP {payload_type}\na=rtpmap:{payload_type} {codec}/90000\n"
    )
    return f"data:application/sdp;base64,{base64.b64encode(sdp.encode()).decode()}"


def _open_port(port: int) -> socket.socket:
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        receiver.bind(("", port))
    except (OSError, OverflowError) as error:
        receiver.close()
        is_taken = getattr(error, "errno", None) == errno.EADDRINUSE
        cause = "is in use by another program" if is_taken else f"cannot be used: {error}"
        raise OpeningError(f"UDP port {port} {cause}") from None
    return receiver


def _receive_packets(receiver: socket.socket, timeout_s: float) -> list[bytes]:
    """Return the packets received within `timeout_s` seconds, up to `_MAX_PACKETS` or to the first that is not RTP."""
    packets: list[bytes] = []
    end_s = time.monotonic() + timeout_s
    with suppress(TimeoutError):
        while len(packets) < _MAX_PACKETS and (left_s := end_s - time.monotonic()) > 0:
            receiver.settimeout(left_s)
            packets.append(receiver.recv(65536))
            if not _is_rtp(packets[-1]):
                break
    return packets


def _is_rtp(packet: bytes) -> bool:
    return len(packet) > _HEADER_BYTES and packet[0] & 0xC0 == _VERSION_2


def _find_codec(packet: bytes) -> tuple[int, str] | None:
    """Return the payload type and codec name of an RTP packet; None if the packet does not reveal the codec."""
    payload_type, start = packet[1] & 0x7F, _HEADER_BYTES + 4 * (packet[0] & 0x0F)
    if packet[0] & 0x10:  # a header extension, whose length is counted in words
        start += 4 + 4 * int.from_bytes(packet[start + 2 : start + 4], "big")
    payload = packet[start : start + 2]
    if payload_type in _STATIC_TYPES:
        return payload_type, _STATIC_TYPES[payload_type]
    if payload_type < _FIRST_DYNAMIC_TYPE or len(payload) < 2 or payload[0] & 0x80:
        return None
    # The second byte of H.265 has a layer (0) and a temporal layer (from 1); in H.264 it is data or a fragment type.
    if payload[0] >> 1 in _H265_TYPES and not payload[0] & 1 and 1 <= payload[1] <= 7:
        return payload_type, "H265"
    return (payload_type, "H264") if payload[0] & 0x1F in _H264_TYPES else None
