"""The sources that the autopilot is to navigate by, where its operator has allowed us to ask for them."""

import math

from edgevpr.core.config import SourceSetsConfig

_GOOD_FOR_S = 10.0  # before GPS is asked for again


class SourceSets:
    """Decides which set of sources to ask for: that without GPS as soon as GPS is lost or wrong and there is a position
    of ours, that with GPS when it has been good for ten seconds. Without both numbers nothing is ever asked for."""

    def __init__(self, settings: SourceSetsConfig) -> None:
        self._with_gps, self._without = settings.gps, settings.no_gps
        self._asked: int | None = None
        self._bad_s = -math.inf

    def wanted(self, now_s: float, has_gps: bool, has_own: bool) -> int | None:
        """Return the number of the set to ask for now; None: there is nothing to ask."""
        if self._with_gps is None or self._without is None:
            return None
        if not has_gps:
            self._bad_s = now_s
        wanted = self._without if not has_gps and has_own else None
        if self._asked == self._without and now_s - self._bad_s > _GOOD_FOR_S:
            wanted = self._with_gps
        if wanted is None or wanted == self._asked:
            return None
        self._asked = wanted
        return wanted
