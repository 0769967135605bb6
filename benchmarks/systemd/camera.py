"""A camera of the network, as a process that can be killed: `python camera.py PICTURES PORT RATE_HZ`.

It sends the JPEG files of a folder to and fro, as MJPEG over HTTP, to whoever asks. SIGUSR1 freezes it: the same
picture again and again; SIGUSR2 ends that.
"""

import signal
import socket
import sys
import threading
import time
from itertools import cycle
from pathlib import Path

_HEAD = b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace;boundary=part\r\n\r\n"


class Camera:
    def __init__(self, folder: Path, rate_hz: float) -> None:
        pictures = [path.read_bytes() for path in sorted(folder.glob("*.jpg"))]
        self._pictures = cycle(pictures + pictures[-2:0:-1])
        self._rate_hz = rate_hz
        self.is_frozen = False
        self._newest = next(self._pictures)

    def turn(self) -> None:
        while True:
            time.sleep(1 / self._rate_hz)
            if not self.is_frozen:
                self._newest = next(self._pictures)

    def show(self, viewer: socket.socket) -> None:
        try:
            viewer.recv(4096)
            viewer.sendall(_HEAD)
            while True:
                jpeg = self._newest
                head = f"--part\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n".encode()
                viewer.sendall(head + jpeg + b"\r\n")
                time.sleep(1 / self._rate_hz)
        except OSError:
            viewer.close()


def main() -> None:
    folder, port, rate_hz = Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
    camera = Camera(folder, rate_hz)
    signal.signal(signal.SIGUSR1, lambda *_: setattr(camera, "is_frozen", True))
    signal.signal(signal.SIGUSR2, lambda *_: setattr(camera, "is_frozen", False))
    threading.Thread(target=camera.turn, daemon=True).start()
    server = socket.create_server(("127.0.0.1", port))
    while True:
        viewer = server.accept()[0]
        threading.Thread(target=camera.show, args=(viewer,), daemon=True).start()


if __name__ == "__main__":
    main()
