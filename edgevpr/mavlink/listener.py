"""The interface that a link needs of whoever navigates by what the autopilot says, and whose position it sends."""

from typing import Protocol

from edgevpr.core.types import Vehicle
from edgevpr.mavlink.attitude import Attitude
from edgevpr.mavlink.autopilots.channel import Channel
from edgevpr.mavlink.positions import State


class Listener(Protocol):
    """Hears the motion of the vehicle, in the thread of the link; its methods never block and never raise."""

    def hear_autopilot(self, t_s: float) -> None:
        """Take in that there is an autopilot from `t_s` on, or another one than before."""
        ...

    def hear_channel(self, channel: Channel) -> None:
        """Take in by which channel the autopilot is told positions, when that has been found out."""
        ...

    def hear_vehicle(self, vehicle: Vehicle) -> None:
        """Take in a report of position and velocity."""
        ...

    def hear_force(self, t_s: float, force_m_s2: tuple[float, float, float], attitude: Attitude) -> None:
        """Take in what the accelerometers feel (nose, right, down) at an attitude."""
        ...

    def state_at(self, t_s: float) -> State | None:
        """Return where the vehicle is or was, to be sent as a continuous position; None: that is not known well
        enough."""
        ...


class NoListener:
    """Stands in for a `Listener` where nobody navigates."""

    def hear_autopilot(self, t_s: float) -> None:
        pass

    def hear_channel(self, channel: Channel) -> None:
        pass

    def hear_vehicle(self, vehicle: Vehicle) -> None:
        pass

    def hear_force(self, t_s: float, force_m_s2: tuple[float, float, float], attitude: Attitude) -> None:
        pass

    def state_at(self, t_s: float) -> State | None:
        return None
