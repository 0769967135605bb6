"""A camera that speaks RTSP on loopback, to one viewer at a time: the RTP packets that ffmpeg sends to `rtp_port` are
handed on, interleaved with the control connection (RFC 2326, section 10.12)."""

import select
import socket
import threading


class RtspCamera:
    def __init__(self, sdp: str, rtp_port: int, port: int):
        self.uri = f"rtsp://127.0.0.1:{port}/camera"
        self._sdp = f"{sdp.rstrip()}\r\na=control:track0\r\n"
        self._rtp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._rtp.bind(("127.0.0.1", rtp_port))
        self._listener = socket.create_server(("127.0.0.1", port))
        self._viewer: socket.socket | None = None
        self._playing = False
        self._on = True
        self.is_silent = False  # it stays connected, and hands nothing on
        self._thread = threading.Thread(target=self._serve)
        self._thread.start()

    def switch_off(self) -> None:
        self._on = False
        self._thread.join()

    def _serve(self) -> None:
        while self._on:
            sockets = [s for s in (self._listener, self._rtp, self._viewer) if s]
            ready, _, _ = select.select(sockets, [], [], 0.05)
            try:
                if self._listener in ready:
                    self._viewer, _ = self._listener.accept()
                    self._playing = False
                elif self._viewer in ready:
                    self._answer(self._viewer.recv(65536))
                if self._rtp in ready:
                    self._hand_on(self._rtp.recv(65536))
            except OSError:
                self._let_viewer_go()
        for end in (self._viewer, self._listener, self._rtp):
            if end:
                end.close()

    def _hand_on(self, packet: bytes) -> None:
        if self._viewer and self._playing and not self.is_silent:
            self._viewer.sendall(b"$\x00" + len(packet).to_bytes(2, "big") + packet)

    def _answer(self, request: bytes) -> None:
        if not request:
            self._let_viewer_go()
        if not request or request.startswith(b"$"):  # the viewer's own reports on what it received
            return
        method, *lines = request.decode().split("\r\n")
        method = method.split(" ")[0]
        number = next(line for line in lines if line.startswith("CSeq"))
        body = self._sdp if method == "DESCRIBE" else ""
        headers = {
            "OPTIONS": "Public: DESCRIBE, SETUP, PLAY, TEARDOWN",
            "DESCRIBE": f"Content-Type: application/sdp\r\nContent-Base: {self.uri}/",
            "SETUP": "Transport: RTP/AVP/TCP;unicast;interleaved=0-1",
        }.get(method, "Range: npt=0-")
        answer = ["RTSP/1.0 200 OK", number, "Session: 1", headers, f"Content-Length: {len(body)}", "", body]
        self._viewer.sendall("\r\n".join(answer).encode())
        if method in ("PLAY", "TEARDOWN"):  # every half minute a viewer asks for something only to keep the session
            self._playing = method == "PLAY"

    def _let_viewer_go(self) -> None:
        if self._viewer:
            self._viewer.close()
        self._viewer, self._playing = None, False
