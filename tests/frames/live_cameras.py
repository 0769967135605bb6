"""Test cameras: ffmpeg on loopback, which can be switched off and on again like a plug being pulled."""

import subprocess
import time
from pathlib import Path

import imageio_ffmpeg
from loopback import free_port
from rtsp_camera import RtspCamera

WIDTH, HEIGHT = 160, 120


def start_ffmpeg(*output: str) -> subprocess.Popen:
    picture = ["-re", "-f", "lavfi", "-i", f"testsrc=size={WIDTH}x{HEIGHT}:rate=60"]
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "quiet", *picture, "-g", "5", *output]
    return subprocess.Popen(command, stdin=subprocess.DEVNULL)


def stop(process: subprocess.Popen) -> None:
    process.kill()
    process.wait()


class FfmpegCamera:
    """MPEG-TS over UDP or TCP, or MJPEG over HTTP."""

    def __init__(self, kind: str):
        port = free_port()
        self.uri = f"{kind}://127.0.0.1:{port}"
        self._output = {
            "udp": ["-c:v", "mpeg2video", "-f", "mpegts", f"{self.uri}?pkt_size=1316"],
            "tcp": ["-c:v", "mpeg2video", "-f", "mpegts", f"{self.uri}?listen=1"],
            "http": ["-c:v", "mjpeg", "-f", "mpjpeg", "-listen", "1", self.uri],
        }[kind]

    def switch_on(self) -> None:
        self._process = start_ffmpeg(*self._output)

    def switch_off(self) -> None:
        stop(self._process)


class RtpCamera:
    """RTP to a port of this machine, described by an .sdp file."""

    def __init__(self, folder: Path):
        self.port = free_port()
        self.sdp_path = folder / "camera.sdp"
        self.uri = str(self.sdp_path)

    def switch_on(self) -> None:
        rtp = f"rtp://127.0.0.1:{self.port}?pkt_size=1200"
        self._process = start_ffmpeg("-c:v", "mpeg2video", "-f", "rtp", "-sdp_file", str(self.sdp_path), rtp)
        while not (self.sdp_path.exists() and "framerate" in self.sdp_path.read_text()):
            time.sleep(0.02)

    def switch_off(self) -> None:
        stop(self._process)


class RtspOverRtp:
    """An RTSP camera in front of an RTP one; the plug that is pulled is the RTSP camera's."""

    def __init__(self, folder: Path):
        self._inner = RtpCamera(folder)
        self._inner.switch_on()
        self._port = free_port()
        self.uri = f"rtsp://127.0.0.1:{self._port}/camera"

    def switch_on(self) -> None:
        self._outer = RtspCamera(self._inner.sdp_path.read_text(), self._inner.port, self._port)

    def switch_off(self) -> None:
        self._outer.switch_off()

    def scrap(self) -> None:
        self._inner.switch_off()
