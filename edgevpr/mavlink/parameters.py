"""The tables of an autopilot's parameters: for every parameter that changes what our messages do, which values are
right, and what happens with others; and the choice of a channel from them.

The rows stand in `ardupilot_parameters` and `px4_parameters`. They serve the flight, which sends nothing while a
parameter is not answered or is dangerous, `edgevpr doctor`, and the page docs/reference/parameters.md.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.mavlink.channel import OLD_NAMES, Channel, ChannelChoice, Parameters, VehicleKind, read_value, resolve_name

# Names of other releases. After ArduPilot 4.6 ARMING_SKIPCHK, the checks to leave out, replaces ARMING_CHECK.
ALTERNATIVES = {**OLD_NAMES, "ARMING_CHECK": "ARMING_SKIPCHK"}
MAX_OFFSET_M = 1.0  # of an antenna or a camera: a position that is moved by more is wrong by more than a good fix
MAX_DELAY_MS = 50.0  # we send the position of the moment, so at 25 m/s this is wrong by 1.2 m


class Check(NamedTuple):
    """The `names` of the parameters that `find_changes` reads. It gets all values that were read and the
    channel chosen for them, and returns the changes, such as "GPS_PRIMARY=0"; none if the values are right."""

    names: tuple[str, ...]
    find_changes: Callable[[Parameters, ChannelChoice], Iterable[str]]


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterRule:
    """A row of a table: its `label`, by which a pilot finds it, the `channels` that it matters for, the values that are
    `right`, in words, and `why`: the effect of a wrong one, in a sentence."""

    label: str
    channels: tuple[Channel, ...]
    is_dangerous: bool
    right: str
    check: Check
    why: str


@dataclass(frozen=True, slots=True)
class ParameterFault:
    """A rule that the autopilot's parameters break, and the changes that put it right."""

    rule: ParameterRule
    changes: tuple[str, ...]

    @property
    def reason(self) -> Reason:
        """The reason why nothing is sent, or the channel is weak, with what to change."""
        code = ReasonCode.PARAMETER_DANGEROUS if self.rule.is_dangerous else ReasonCode.PARAMETER_WEAK
        return Reason(code, {"changes": " and ".join(self.changes), "why": self.rule.why})

    @property
    def brief(self) -> str:
        """The advice for a ground station, in forty characters."""
        return f"set {self.changes[0]}{' ...' if self.changes[1:] else ''}"


@dataclass(frozen=True, slots=True)
class Decision:
    """A choice, the `missing` parameters without which it cannot be made, and the `faults` of the channel's table rows:
    if the first is dangerous, nothing is sent."""

    choice: ChannelChoice
    missing: tuple[str, ...] = ()
    faults: tuple[ParameterFault, ...] = ()


@dataclass(frozen=True)
class ParameterTable:
    """All about a firmware's parameters: its `name`, the parameters that are `deciding` which channel it is, the
    `rules` for all, and the function that chooses the channel."""

    name: str
    deciding: tuple[str, ...]
    rules: tuple[ParameterRule, ...]
    choose: Callable[[VehicleKind, Parameters], ChannelChoice]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The names of all parameters, the deciding ones first; of two names of one parameter, the new one."""
        return self._join(self.rules)

    @cached_property
    def all_names(self) -> frozenset[str]:
        """The names of all parameters, and those that they have in other releases."""
        return frozenset(self.names).union(filter(None, map(ALTERNATIVES.get, self.names)))

    def list_needed(self, choice: ChannelChoice) -> tuple[str, ...]:
        """Return the names of the parameters that must be known before anything is sent by the channel of `choice`."""
        return self._join(rule for rule in self.rules if choice.channel in rule.channels)

    def find_faults(self, choice: ChannelChoice, parameters: Parameters) -> tuple[ParameterFault, ...]:
        """Return the rules that `parameters` break for the channel of `choice`, the dangerous ones first."""
        ours = (rule for rule in self.rules if choice.channel in rule.channels)
        faults = (ParameterFault(rule, tuple(rule.check.find_changes(parameters, choice))) for rule in ours)
        broken = (fault for fault in faults if fault.changes)
        return tuple(sorted(broken, key=lambda fault: not fault.rule.is_dangerous))

    def decide(self, kind: VehicleKind, parameters: Parameters, is_known: Callable[[str], bool]) -> Decision:
        """Choose the channel. `parameters` has the values that were read; `is_known` returns whether a parameter's
        value was read, or the autopilot is known not to have it."""
        if missing := tuple(name for name in self.deciding if not is_known(name)):
            return _decide_to_wait(missing)
        choice = self.choose(kind, parameters)
        if missing := tuple(name for name in self.list_needed(choice) if not is_known(name)):
            return _decide_to_wait(missing)
        faults = self.find_faults(choice, parameters)
        if faults and faults[0].rule.is_dangerous:
            choice = replace(choice, channel=Channel.NONE, reason=faults[0].reason)
        return Decision(choice, (), faults)

    def _join(self, rules: Iterable[ParameterRule]) -> tuple[str, ...]:
        return tuple(dict.fromkeys((*self.deciding, *(name for rule in rules for name in rule.check.names))))


def _decide_to_wait(missing: tuple[str, ...]) -> Decision:
    reason = Reason(ReasonCode.PARAMETERS_UNANSWERED, {"names": ", ".join(missing)})
    return Decision(ChannelChoice(Channel.NONE, reason), missing)


def require(channels: tuple[Channel, ...], right: str, check: Check, why: str, label: str = "") -> ParameterRule:
    """Make a rule for values with which an aircraft can be lost that would be fine alone: nothing may be sent then. The
    `label` is the name of the first parameter, unless another one is given."""
    return replace(recommend(channels, right, check, why, label), is_dangerous=True)


def recommend(channels: tuple[Channel, ...], right: str, check: Check, why: str, label: str = "") -> ParameterRule:
    """Make a rule for values with which we are only useless, or weak."""
    label = label or check.names[0]
    return ParameterRule(label=label, channels=channels, is_dangerous=False, right=right, check=check, why=why)


def expect(advised: float, *names: str, allows: Callable[[float], bool] | None = None) -> Check:
    """Return a check that advises NAME=`advised` for each of the parameters whose value `allows` refuses (by default
    any but `advised`). A parameter that the autopilot does not have is right."""

    def find_changes(parameters: Parameters, _choice: ChannelChoice) -> Iterator[str]:
        for name in names:
            value = read_value(parameters, name, advised)
            if not (value == advised if allows is None else allows(value)):
                yield f"{resolve_name(parameters, name)}={advised:g}"

    return Check(names, find_changes)


def join_checks(*checks: Check) -> Check:
    """Join checks to one that advises the changes of all."""
    names = tuple(name for check in checks for name in check.names)
    return Check(names, lambda *read: (change for check in checks for change in check.find_changes(*read)))


def make_limit(limit: float) -> Callable[[float], bool]:
    """Return a function that allows values up to a limit."""
    return lambda value: value <= limit


def is_small_offset(value_m: float) -> bool:
    """Return True for a coordinate of an antenna or a camera that does no harm."""
    return abs(value_m) <= MAX_OFFSET_M


def has_bit(value: float, bit: int) -> bool:
    """Return True if a bit mask contains the bit of this value (1, 2, 4, ...)."""
    return bool(int(value) & bit)


def list_axes(prefix: str) -> tuple[str, ...]:
    """Return the names of the three coordinates of a position in the airframe."""
    return tuple(f"{prefix}_{axis}" for axis in "XYZ")
