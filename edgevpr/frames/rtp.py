"""RTP that is sent to a UDP port without a description (RFC 3550), as many companion computers and ground stations do.
FFmpeg needs an SDP (RFC 8866) that names the codec; it is made here from the first packets."""

import base64
import errno
import ipaddress
import socket
import time
from collections import Counter
from contextlib import suppress
from urllib.parse import parse_qs, urlsplit

from edgevpr.frames.shot import OpeningError

_VERSION_2 = 0x80  # the two highest bits of an RTP packet
_HEADER_BYTES = 12
_PACKETS = 10  # by which the codec is found: most of them are fragments, which no other codec's packets look like
_STATIC_TYPES = {26: "JPEG", 32: "MPV", 33: "MP2T"}  # payload types of RFC 3551
_FIRST_DYNAMIC_TYPE = 96
_H264_TYPES = (1, 5, 6, 7, 8, 9, 24, 28)  # of NAL units, aggregates and fragments (RFC 6184)
_H265_TYPES = (0, 1, 19, 20, 21, 32, 33, 34, 35, 39, 48, 49)  # the same (RFC 7798)


def describe_rtp(uri: str, timeout_s: float) -> tuple[str, dict[str, str]] | None:
    """Wait for packets at `uri`, udp://[HOST]:PORT or rtp://[HOST]:PORT. If they are RTP, return the address of an SDP
    that describes them, and options of FFmpeg for it; None if they are something else, which FFmpeg may know. Raises
    OpeningError if no packet comes, if the port is in use, or if the codec is none of H.264, H.265, JPEG, MPEG-2 and
    MPEG-TS."""
    try:
        host, port = urlsplit(uri).hostname or "", urlsplit(uri).port or 0
    except ValueError:
        raise OpeningError("no host and port in the address") from None
    group = host if _is_multicast(host) else ""
    local = parse_qs(urlsplit(uri).query).get("localaddr", ["0.0.0.0"])[0]
    with _receiver(port, group, local) as receiver:
        packets = _receive(receiver, timeout_s)
    if not packets:
        if group or "?" in uri or ":" in host:  # FFmpeg may know better how to receive them
            return None
        raise OpeningError(f"no packet at UDP port {port} within {timeout_s:g} s")
    if not all(map(_is_rtp, packets)):
        return None
    codecs = Counter(codec for codec in map(_codec_of, packets) if codec)
    if not codecs:
        kind = packets[0][1] & 0x7F
        raise OpeningError(f"RTP of an unknown codec (payload type {kind}): describe it in an .sdp file")
    # FFmpeg would not free the first port if it could not have the second.
    _receiver(port + 1, group, local).close()
    (kind, codec), _ = codecs.most_common(1)[0]
    lines = (
        *("v=0", "o=- 0 0 IN IP4 127.0.0.1", "s=camera", f"c=IN IP4 {group or '0.0.0.0'}", "t=0 0"),
        *(f"m=video {port} RTP/AVP {kind}", f"a=rtpmap:{kind} {codec}/90000", ""),
    )
    sdp = base64.b64encode("\n".join(lines).encode()).decode()
    return f"data:application/sdp;base64,{sdp}", {"localaddr": local} if group else {}


def _is_multicast(host: str) -> bool:
    with suppress(ValueError):
        return ipaddress.IPv4Address(host).is_multicast
    return False


def _receiver(port: int, group: str, local: str) -> socket.socket:
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        if group:
            receiver.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            member = socket.inet_aton(group) + socket.inet_aton(local)
            receiver.setsockopt(socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, member)
        receiver.bind((group, port))
    except (OSError, OverflowError) as error:
        receiver.close()
        is_taken = getattr(error, "errno", None) == errno.EADDRINUSE
        why = "is in use by another program" if is_taken else f"cannot be used: {error}"
        raise OpeningError(f"UDP port {port} {why}") from None
    return receiver


def _receive(receiver: socket.socket, timeout_s: float) -> list[bytes]:
    """Return the first packets: one that is no RTP, or some that are; as many as come in `timeout_s` seconds."""
    packets: list[bytes] = []
    end_s = time.monotonic() + timeout_s
    with suppress(TimeoutError):
        while len(packets) < _PACKETS and (left_s := end_s - time.monotonic()) > 0:
            receiver.settimeout(left_s)
            packets.append(receiver.recv(65536))
            if not _is_rtp(packets[-1]):
                break
    return packets


def _is_rtp(packet: bytes) -> bool:
    return len(packet) > _HEADER_BYTES and packet[0] & 0xC0 == _VERSION_2


def _codec_of(packet: bytes) -> tuple[int, str] | None:
    """Return the payload type and the name of the codec of an RTP packet, None if the packet does not show it."""
    kind, start = packet[1] & 0x7F, _HEADER_BYTES + 4 * (packet[0] & 0x0F)
    if packet[0] & 0x10:  # an extension, with its length in words
        start += 4 + 4 * int.from_bytes(packet[start + 2 : start + 4], "big")
    payload = packet[start : start + 2]
    if kind in _STATIC_TYPES:
        return kind, _STATIC_TYPES[kind]
    if kind < _FIRST_DYNAMIC_TYPE or len(payload) < 2 or payload[0] & 0x80:
        return None
    # The second byte of H.265 is a layer (0) and a temporal layer from 1; in H.264 it is data, or a fragment's type.
    if payload[0] >> 1 in _H265_TYPES and not payload[0] & 1 and 1 <= payload[1] <= 7:
        return kind, "H265"
    return (kind, "H264") if payload[0] & 0x1F in _H264_TYPES else None
