"""Carrying out of what ground stations request in flight: recognition pauses and resumes, learning stops and resumes.
The loop of `flight` and `vitals` use it."""

from edgevpr.mavlink.ground import Wish, Wished
from edgevpr.mavlink.messages import Severity
from edgevpr.runtime.flight.world import Crew

_TEXTS = {
    Wish.PAUSE: ("paused by command", "pause"),
    Wish.RESUME: ("goes on by command", "pause"),
    Wish.LEARN: ("learning on by command", "learning"),
    Wish.LEARN_NOTHING: ("learning off by command", "learning"),
}


class Commands:
    """Carries out the requests (`Wish`) of ground stations. While the flight `is_paused`, nothing is recognised and no
    fix is sent. Learning can be switched only if there is a learner and it works."""

    def __init__(self, crew: Crew) -> None:
        self.is_paused = False
        self._link, self._herald, self._learner = crew.link, crew.herald, crew.learner

    @property
    def summary(self) -> str | None:
        """Features that a ground station has switched off, in a few words; None if there are none."""
        off = ("paused" if self.is_paused else "", "learning off" if self._learner and self._learner.is_off else "")
        return ", ".join(filter(None, off)) or None

    def obey(self) -> None:
        """Carry out the requests received since the last call. Then tell the link which requests to accept from now
        on."""
        if self._link is None:
            return
        for wished in self._link.take_wishes():
            self._fulfil(wished)
        can_learn = self._learner is not None and self._learner.trouble is None
        self._link.offer(tuple(Wish) if can_learn else (Wish.PAUSE, Wish.RESUME))

    def _fulfil(self, wished: Wished) -> None:
        before = self.summary
        match wished.wish:
            case Wish.PAUSE | Wish.RESUME:
                self.is_paused = wished.wish is Wish.PAUSE
            case Wish.LEARN | Wish.LEARN_NOTHING if self._learner:
                self._learner.is_off = wished.wish is Wish.LEARN_NOTHING
        is_new = before != self.summary
        text, topic = _TEXTS[wished.wish]
        self._herald.note("command", wish=wished.wish.name, sender=wished.sender, said=text, is_new=is_new)
        if is_new:  # a command repeated because its answer was lost changes nothing
            self._herald.say(Severity.INFO, f"{text}, as {wished.sender} wishes", ground=text, topic=topic)
