"""The condition of a source of frames, for programs; its `state` gives the same in words, for people."""

from enum import Enum, auto


class Condition(Enum):
    """The condition of a source: OPENING until the first picture comes or the opening fails, RUNNING while new and
    whole pictures come, DAMAGED while none of those that come is whole, FROZEN while the same picture comes over and
    over, LOST while none come and the source is reopened again and again, ENDED when no more will come."""

    OPENING = auto()
    RUNNING = auto()
    DAMAGED = auto()
    FROZEN = auto()
    LOST = auto()
    ENDED = auto()
