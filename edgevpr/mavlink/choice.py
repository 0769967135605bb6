"""The choice of a channel from the parameters that the autopilot has answered, and from the table of right and
dangerous values. While a parameter is not answered, or is dangerous, the channel is `Channel.NONE`: nothing is sent."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property

from edgevpr.mavlink.ardupilot_parameters import ARDUPILOT_DECIDING, ARDUPILOT_RULES
from edgevpr.mavlink.channel import Channel, Choice, Kind, ardupilot_choice, px4_choice
from edgevpr.mavlink.parameters import ParameterFault, ParameterRule, Parameters, find_faults, name_alternative
from edgevpr.mavlink.px4_parameters import PX4_DECIDING, PX4_RULES
from edgevpr.mavlink.wire import mavlink


@dataclass(frozen=True, slots=True)
class Decision:
    """A choice, the `missing` parameters without which it cannot be made, and the `faults` of the channel's table rows:
    if the first is dangerous, nothing is sent."""

    choice: Choice
    missing: tuple[str, ...] = ()
    faults: tuple[ParameterFault, ...] = ()


@dataclass(frozen=True)
class ParameterTable:
    """All about a firmware's parameters: its `name`, the parameters that are `deciding` which channel it is, the
    `rules` for all, and the function that chooses the channel."""

    name: str
    deciding: tuple[str, ...]
    rules: tuple[ParameterRule, ...]
    choose: Callable[[Kind, Parameters], Choice]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The names of all parameters, the deciding ones first; of two names of one parameter, the new one."""
        return self._join(self.rules)

    @cached_property
    def all_names(self) -> frozenset[str]:
        """The names of all parameters, and those that they have in other releases."""
        return frozenset(self.names).union(filter(None, map(name_alternative, self.names)))

    def name_needed(self, choice: Choice) -> tuple[str, ...]:
        """Return the names of the parameters that must be known before anything is sent by the channel of `choice`."""
        return self._join(rule for rule in self.rules if choice.channel in rule.channels)

    def decide(self, kind: Kind, parameters: Parameters, is_known: Callable[[str], bool]) -> Decision:
        """Choose the channel. `parameters` has the values that were read; `is_known` returns whether a parameter's
        value was read, or the autopilot is known not to have it."""
        if missing := tuple(name for name in self.deciding if not is_known(name)):
            return _wait_for(missing)
        choice = self.choose(kind, parameters)
        if missing := tuple(name for name in self.name_needed(choice) if not is_known(name)):
            return _wait_for(missing)
        faults = find_faults(self.rules, choice, parameters)
        if faults and faults[0].rule.is_dangerous:
            reason = f"not sent: {faults[0].advice}. {faults[0].rule.why}"
            choice = replace(choice, channel=Channel.NONE, reason=reason)
        return Decision(choice, (), faults)

    def _join(self, rules: Iterable[ParameterRule]) -> tuple[str, ...]:
        return tuple(dict.fromkeys((*self.deciding, *(name for rule in rules for name in rule.names))))


def _wait_for(missing: tuple[str, ...]) -> Decision:
    more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
    reason = f"not sent: the autopilot has not answered for {', '.join(missing[:3])}{more}"
    return Decision(Choice(Channel.NONE, reason), missing)


TABLES = {
    mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: ParameterTable(
        "ArduPilot", ARDUPILOT_DECIDING, ARDUPILOT_RULES, ardupilot_choice
    ),
    mavlink.MAV_AUTOPILOT_PX4: ParameterTable("PX4", PX4_DECIDING, PX4_RULES, px4_choice),
}
