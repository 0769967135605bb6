"""edgevpr with a camera of which one call never returns: `python hanging_camera.py STEP MARK run ...`. STEP is that of
a capture, or `main`: the main thread hangs, with its first query. MARK is a file that is made when it does."""

import ctypes
import itertools
import sys
import time
from pathlib import Path

from pictures import draw_texture

from edgevpr.cli.main import program
from edgevpr.frames import source
from edgevpr.frames.shot import Capture, Shot
from edgevpr.runtime.flight.flight import Flight

_STEP = sys.argv[1]
_MARK = Path(sys.argv[2])
_PICTURES = 5
_SEEDS = itertools.count()  # of all openings: pictures that repeat would count as patched


def hang() -> None:
    """Wait for a lock that is never opened, in C: no signal ends that, and Python's handler is not called."""
    _MARK.touch()
    libc, mutex = ctypes.CDLL(None), ctypes.create_string_buffer(256)
    libc.pthread_mutex_lock(mutex)
    libc.pthread_mutex_lock(mutex)


class HangingCapture(Capture):
    """Gives ten pictures a second, and hangs in its step; or is lost, if that is `release`."""

    def __init__(self) -> None:
        self._number = 0
        if _STEP == "open":
            hang()

    def read(self) -> Shot | None:
        time.sleep(0.1)
        self._number += 1
        if self._number > _PICTURES and _STEP in ("read", "release"):
            return hang() if _STEP == "read" else None
        picture = draw_texture(next(_SEEDS), 240, 320)
        return Shot(t_mono_s=time.monotonic(), thumbnail=picture[::4, ::4], convert=lambda: self._pixels(picture))

    def _pixels(self, picture):
        if self._number > _PICTURES and _STEP == "pixels":
            hang()
        return picture

    def release(self) -> None:
        hang()


if __name__ == "__main__":
    source._make_capture = lambda *_: HangingCapture
    if _STEP == "main":
        Flight._publish = lambda *_: hang()
    del sys.argv[1:3]
    program()
