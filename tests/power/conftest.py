"""What the tests of this room share: trees of files that stand for a machine's /proc and /sys, and a fake clock."""

import pytest


@pytest.fixture
def tree(tmp_path):
    """Write files below a root: tree({"proc/meminfo": "..."}) -> the root. Further calls change and add files."""

    def write(files):
        for name, text in files.items():
            path = tmp_path / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return tmp_path

    return write


class Clock:
    """A clock that moves only when somebody sleeps; `at(t_s, act)` lets things happen meanwhile."""

    def __init__(self):
        self.now_s = 1000.0
        self._events = []

    def __call__(self):
        return self.now_s

    def at(self, t_s, act):
        self._events.append((t_s, act))
        self._events.sort(key=lambda event: event[0])

    def sleep(self, seconds):
        until_s = self.now_s + seconds
        while self._events and self._events[0][0] <= until_s - 1000.0 + 1e-9:
            self._events.pop(0)[1]()
        self.now_s = until_s


@pytest.fixture
def clock():
    return Clock()
