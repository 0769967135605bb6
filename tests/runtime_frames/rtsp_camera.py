"""A camera that speaks RTSP on loopback, for one viewer: the RTP packets that ffmpeg sends to `rtp_port` are handed on,
interleaved with the control connection (RFC 2326, section 10.12)."""

import select
import socket
import threading


class RtspCamera:
    def __init__(self, sdp: str, rtp_port: int, port: int):
        self._sdp = sdp.rstrip() + "\r\na=control:track0\r\n"
        self._rtp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._rtp.bind(("127.0.0.1", rtp_port))
        self._listener = socket.create_server(("127.0.0.1", port))
        self.uri = f"rtsp://127.0.0.1:{port}/camera"
        self._on = True
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def switch_off(self) -> None:
        self._on = False
        self._thread.join()

    def _serve(self) -> None:
        viewer: socket.socket | None = None
        playing = False
        while self._on:
            ready, _, _ = select.select([self._listener, self._rtp] + ([viewer] if viewer else []), [], [], 0.05)
            if self._listener in ready:
                viewer, _ = self._listener.accept()
                playing = False
            if self._rtp in ready:
                packet = self._rtp.recv(65536)
                if viewer and playing:
                    viewer.sendall(b"$\x00" + len(packet).to_bytes(2, "big") + packet)
            if viewer and viewer in ready:
                request = viewer.recv(65536)
                if request.startswith(b"$"):  # the viewer's receiver reports
                    continue
                if not request:
                    viewer.close()
                    viewer = None
                    continue
                playing = self._answer(viewer, request.decode()) or playing
        for end in (viewer, self._listener, self._rtp):
            if end:
                end.close()

    def _answer(self, viewer: socket.socket, request: str) -> bool:
        """Answer one request; whether it was PLAY."""
        method = request.split(" ", 1)[0]
        headers = dict(line.split(": ", 1) for line in request.split("\r\n")[1:] if ": " in line)
        body, extra = "", {"Session": "1"}
        if method == "OPTIONS":
            extra = {"Public": "DESCRIBE, SETUP, PLAY, TEARDOWN"}
        elif method == "DESCRIBE":
            body = self._sdp
            extra = {"Content-Type": "application/sdp", "Content-Base": self.uri + "/"}
        elif method == "SETUP":
            extra["Transport"] = "RTP/AVP/TCP;unicast;interleaved=0-1"
        lines = ["RTSP/1.0 200 OK", f"CSeq: {headers['CSeq']}", *(f"{name}: {value}" for name, value in extra.items())]
        viewer.sendall("\r\n".join([*lines, f"Content-Length: {len(body)}", "", body]).encode())
        return method == "PLAY"
