"""The wishes of the ground for a flight, on their way from the links to the loop that fulfils them."""

from collections.abc import Collection
from dataclasses import dataclass
from enum import IntEnum
from threading import Lock

PAUSED = "not sent: paused by the ground"


class Wish(IntEnum):
    """A wish for the flight: the first parameter of MAV_CMD_USER_1 (31010)."""

    PAUSE = 1
    RESUME = 2
    LEARN = 3
    LEARN_NOTHING = 4


@dataclass(frozen=True, slots=True)
class Wished:
    """A wish, and who has it."""

    wish: Wish
    system_id: int
    component_id: int

    @property
    def sender(self) -> str:
        """The sender as system/component."""
        return f"{self.system_id}/{self.component_id}"


class Wishes:
    """The wishes that wait to be fulfilled, from any number of threads to that of the flight. `offered` are those that
    can be fulfilled; there are none before a flight says so."""

    def __init__(self) -> None:
        self.offered: Collection[Wish] = ()
        self._lock = Lock()
        self._waiting: dict[bool, Wished] = {}  # the newest about learning, and the newest about the flight itself
        self._is_paused = False

    def put(self, wished: Wished) -> None:
        """Let a wish wait. Of two that contradict each other only the newer is left."""
        about_learning = wished.wish in (Wish.LEARN, Wish.LEARN_NOTHING)
        with self._lock:
            if not about_learning:
                self._is_paused = wished.wish is Wish.PAUSE
            self._waiting[about_learning] = wished

    def take(self) -> tuple[Wished, ...]:
        """Return the wishes since the last call."""
        with self._lock:
            waiting, self._waiting = tuple(self._waiting.values()), {}
        return waiting

    def why_no_fix(self) -> str | None:
        """Return the reason why no fix may be sent, from the acknowledgement of a pause on; None: there is none."""
        return PAUSED if self._is_paused else None
