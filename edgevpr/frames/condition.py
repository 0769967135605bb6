"""How a source of frames is, for programs; its `state` says the same in words, for people."""

from enum import Enum, auto


class Condition(Enum):
    """OPENING until a first picture comes or nothing is found there, RUNNING while pictures come, LOST while none do
    and the source is opened again and again, ENDED where none will come any more."""

    OPENING = auto()
    RUNNING = auto()
    LOST = auto()
    ENDED = auto()
