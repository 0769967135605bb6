"""The wishes of the ground, and what becomes of them: the flight pauses and goes on, learning stops and goes on."""

from edgevpr.mavlink.messages import Severity
from edgevpr.mavlink.requests import Wish, Wished
from edgevpr.runtime.flight.world import Crew

_TEXTS = {
    Wish.PAUSE: ("paused by command", "pause"),
    Wish.RESUME: ("goes on by command", "pause"),
    Wish.LEARN: ("learning on by command", "learning"),
    Wish.LEARN_NOTHING: ("learning off by command", "learning"),
}


class Commands:
    """Fulfils the wishes of the ground. While the flight `is_paused` nothing is recognised and no fix is sent. Learning
    can be switched only where there is a learner that has no trouble."""

    def __init__(self, crew: Crew) -> None:
        self.is_paused = False
        self._link, self._herald, self._learner = crew.link, crew.herald, crew.learner

    @property
    def summary(self) -> str | None:
        """Name what the ground has switched off, in a few words; None where it is nothing."""
        off = ("paused" if self.is_paused else "", "learning off" if self._learner and self._learner.is_off else "")
        return ", ".join(filter(None, off)) or None

    def obey(self) -> None:
        """Fulfil the wishes since the last call, and say which ones can be fulfilled from now on."""
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
        if is_new:  # a command that is sent once more, since its answer was lost, changes nothing
            self._herald.say(Severity.INFO, f"{text}, as {wished.sender} wishes", ground=text, topic=topic)
