"""Threads for the calls into drivers and decoders of live sources, any of which may never return.

A thread that hangs in such a call cannot be ended. `frames.live` gives up on it and starts another; the process ends
without it (`cli.main`). A process of its own, which can be ended, was not taken: it needs 40 MB more on a small board,
every picture has to be copied out of it, and a driver that hangs in the kernel holds a process as it holds a thread.
"""

import threading
from collections.abc import Callable
from contextlib import suppress
from queue import SimpleQueue

from edgevpr.core.arrays import Image
from edgevpr.frames.shot import Capture, OpeningError, Refusal, Shot, StreamFacts


class Opening:
    """One opening of a camera or stream, by a thread of its own, which opens it, hands what it reads to `take` (with
    this object), and releases it once it is lost or `cancel` is called.

    `opened_s`: when it was open, by `clock` (None: not yet). `cause`: why it could not be opened or read on, in a few
    words (None: it is lost, or cancelled). `ended`: the thread has released it."""

    def __init__(
        self,
        open_capture: Callable[[], Capture | None],
        take: Callable[["Opening", Shot | Refusal], None],
        clock: Callable[[], float],
    ) -> None:
        self.began_s = clock()
        self.opened_s: float | None = None
        self.cause: str | None = None
        self.is_cancelled = False
        self.ended = threading.Event()
        self._open_capture, self._take, self._clock = open_capture, take, clock
        self._capture: Capture | None = None
        threading.Thread(target=self._run, name="capture", daemon=True).start()

    @property
    def facts(self) -> StreamFacts | None:
        """What the open stream states of its pictures; None if it states nothing."""
        return getattr(self._capture, "facts", None)

    def cancel(self) -> None:
        """Let the thread end as soon as its present call returns."""
        self.is_cancelled = True
        if self._capture is not None:
            self._capture.cancel()

    def _run(self) -> None:
        try:
            self._read()
        except OpeningError as error:
            self.cause = str(error)
        except Exception as error:  # of a driver or a decoder, whatever it is
            self.cause = f"{type(error).__name__}: {error}"
        finally:
            self.ended.set()

    def _read(self) -> None:
        capture = self._open_capture()
        if capture is None:
            self.cause = "nothing there"
            return
        self._capture, self.opened_s = capture, self._clock()
        try:
            while not self.is_cancelled and (shot := capture.read()) is not None:
                self._take(self, shot)
        finally:
            capture.release()


class Conversion:
    """The conversion of a picture, asked for at `began_s`. `image`: the result, once it is `done`; None: it has
    failed."""

    def __init__(self, number: int, shot: Shot, began_s: float) -> None:
        self.number, self.shot, self.began_s = number, shot, began_s
        self.image: Image | None = None
        self.done = threading.Event()


class Converter:
    """A thread that converts pictures, one after the other."""

    def __init__(self) -> None:
        self._asked: SimpleQueue[Conversion | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="convert", daemon=True)
        self._thread.start()

    def has_ended(self) -> bool:
        """Tell whether the thread has ended."""
        return not self._thread.is_alive()

    def ask(self, conversion: Conversion) -> None:
        """Have this done."""
        self._asked.put(conversion)

    def end(self, timeout_s: float = 0.0) -> None:
        """Let the thread end after its present conversion, and wait for that."""
        self._asked.put(None)
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while (conversion := self._asked.get()) is not None:
            with suppress(Exception):  # a picture that a decoder cannot give is left out
                conversion.image = conversion.shot.pixels()
            conversion.done.set()
            del conversion  # its picture is large
