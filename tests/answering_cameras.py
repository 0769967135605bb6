"""Small cameras on loopback: what they answer is given, and what they send are pictures that all differ."""

import itertools
import socket
import threading
import time
from contextlib import suppress

import cv2
import numpy as np
from encoders import Encoder, describe_rtp

WIDTH = 320
HEIGHT = 240
RATE_HZ = 10
_NOISE = np.random.default_rng(0).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
RTCP = 200  # second byte of a packet that is no part of a picture
_SDP = describe_rtp("libx264", 0) + "a=control:track0\r\n"


def draw_picture(number):
    return np.roll(cv2.GaussianBlur(_NOISE, (9, 9), 0), 7 * number, axis=1)


def encode_image(number, extension=".jpg"):
    return bytes(cv2.imencode(extension, draw_picture(number))[1])


class Server:
    """Calls `answer` with each connection, a file of what it says and nothing else, in a thread of its own."""

    def __init__(self, answer, port=0):
        self._answer, self._listener = answer, socket.create_server(("127.0.0.1", port))
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self):
        with suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                threading.Thread(target=self._talk, args=(connection,), daemon=True).start()

    def _talk(self, connection):
        with suppress(OSError, ValueError), connection, connection.makefile("rb") as asked:
            self._answer(connection, asked)

    def close(self):
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)  # else it listens until `accept` returns
        self._listener.close()


def read_request(asked):
    """The first line of a request, and its headers by names in small letters; ValueError at the end. Skips what an RTSP
    viewer reports of the packets received."""
    while (begin := asked.read(1)) == b"$":
        asked.read(int.from_bytes(asked.read(3)[1:], "big"))
    first, headers = (begin + asked.readline()).decode(), {}
    if not first:
        raise ValueError
    while line := asked.readline().decode().strip():
        name, _, value = line.partition(":")
        headers[name.lower()] = value.strip()
    return first, headers


def answer_http(status, kind="text/plain", body=b"nothing"):
    """An answer to every request: `body`, or what it returns for the number of the request."""
    numbers = iter(range(10_000))

    def answer(connection, asked):
        read_request(asked)
        content = body(next(numbers)) if callable(body) else body
        head = f"HTTP/1.0 {status}\r\nContent-Type: {kind}\r\nContent-Length: {len(content)}\r\n\r\n"
        connection.sendall(head.encode() + content)

    return answer


def answer_multipart(kind="image/jpeg", extension=".jpg", has_length=True, *, connections=None):
    """A multipart stream of all pictures in turn. `connections` gets a list of times of sending for each."""

    def answer(connection, asked):
        read_request(asked)
        connection.sendall(b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=part\r\n\r\n")
        sent_s: list[float] = []
        if connections is not None:
            connections.append(sent_s)
        for number in itertools.count():
            data = encode_image(number, extension)
            length = f"Content-Length: {len(data)}\r\n" if has_length else ""
            sent_s.append(time.monotonic())
            connection.sendall(f"--part\r\nContent-Type: {kind}\r\n{length}\r\n".encode() + data + b"\r\n")
            time.sleep(0.1)

    return answer


def answer_rtsp(
    status="200 OK", *, refuses="DESCRIBE", header="X: 1", over_tcp="461", authorization=None, sdp=_SDP, play=None
):
    """A camera that answers the method `refuses` with `status`. A request for TCP gets a 461, or an "offer" of UDP, or
    "200": then `play` is called with the connection of each viewer. `authorization`: what it must be sent."""

    def answer(connection, asked):
        port, is_on = None, threading.Event()
        is_on.set()
        try:
            while True:
                first, headers = read_request(asked)
                method, code, body, more = first.split()[0], "200 OK", "", "Public: DESCRIBE, SETUP, PLAY"
                if method == "DESCRIBE":
                    more, body = "Content-Type: application/sdp", sdp
                if method == "SETUP":
                    _, _, wanted = headers["transport"].partition("client_port=")
                    port = int(wanted.split("-")[0]) if wanted else None
                    more = f"Transport: RTP/AVP;unicast;client_port={wanted or '5000-5001'};server_port=7000-7001"
                    if over_tcp == "200":
                        more = "Transport: RTP/AVP/TCP;unicast;interleaved=0-1"
                    code = "461 Unsupported Transport" if not wanted and over_tcp == "461" else code
                if method == refuses and (authorization is None or headers.get("authorization") != authorization):
                    code, more, body = status, header, ""
                head = f"RTSP/1.0 {code}\r\nCSeq: {headers['cseq']}\r\nSession: 1\r\n{more}\r\n"
                connection.sendall(f"{head}Content-Length: {len(body)}\r\n\r\n{body}".encode())
                if method == "PLAY" and play:
                    play(connection)
                elif method == "PLAY":
                    threading.Thread(target=send_rtp, args=(port, is_on), daemon=True).start()
        finally:
            is_on.clear()

    return answer


class RtspCamera(Server):
    """A camera at `uri` that hands the packets given to `send` to its viewers, by TCP (RFC 2326, section 10.12)."""

    def __init__(self, sdp, port=0):
        self._viewers = []
        answer = answer_rtsp(refuses="", over_tcp="200", sdp=f"{sdp}a=control:track0\r\n", play=self._viewers.append)
        super().__init__(answer, port)
        self.uri = f"rtsp://{self.address}/camera"

    def send(self, packet):
        for viewer in self._viewers:
            with suppress(OSError):  # it has gone
                viewer.sendall(bytes((0x24, packet[1] == RTCP)) + len(packet).to_bytes(2, "big") + packet)

    def close(self):
        super().close()
        for viewer in self._viewers:
            with suppress(OSError):
                viewer.shutdown(socket.SHUT_RDWR)


def send_rtp(port, is_on, codec="libx264"):
    """Send RTP to a port of this machine until `is_on` is cleared."""
    options = (
        {"preset": "ultrafast", "tune": "zerolatency"}
        if codec.startswith("libx")
        else {"huffman": "default", "threads": "1"}
    )
    encoder = Encoder(f"rtp://127.0.0.1:{port}", "rtp", codec, RATE_HZ, (WIDTH, HEIGHT), options | {"g": "5"})
    for number in itertools.count():
        if not is_on.is_set():
            break
        encoder.write(number, draw_picture(number))
        time.sleep(1 / RATE_HZ)
    encoder.close()
