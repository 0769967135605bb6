"""The tables of an autopilot's parameters, and the choice of a channel from them. A table lists every parameter that
affects our messages, its correct values, and the effect of wrong ones.

The rules are in `ardupilot_parameters` and `px4_parameters`. They are used by the flight, which sends nothing while a
parameter is unanswered or dangerous, by `edgevpr doctor`, and by the page docs/reference/parameters.md."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

from edgevpr.core.reasons import Reason, ReasonCode
from edgevpr.mavlink.channel import OLD_NAMES, Channel, ChannelChoice, Parameters, VehicleKind, read_value, resolve_name

# Names in other releases. After ArduPilot 4.6, ARMING_SKIPCHK (the checks to skip) replaces ARMING_CHECK.
ALTERNATIVES = {**OLD_NAMES, "ARMING_CHECK": "ARMING_SKIPCHK"}
MAX_OFFSET_M = 1.0  # of an antenna or camera; a larger offset would exceed the error of a good fix
MAX_DELAY_MS = 50.0  # we send the current position, so at 25 m/s this delay is an error of 1.2 m


class Check(NamedTuple):
    """A check of parameters. `names`: the parameters that `find_changes` reads. `find_changes` takes all values read
    and the channel chosen for them, and returns the changes needed, such as "GPS_PRIMARY=0"."""

    names: tuple[str, ...]
    find_changes: Callable[[Parameters, ChannelChoice], Iterable[str]]


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterRule:
    """A row of a table. `label`: the name that a pilot looks up. `channels`: the channels that it applies to. `right`:
    the correct values, in words. `why`: the effect of a wrong value, in a sentence."""

    label: str
    channels: tuple[Channel, ...]
    is_dangerous: bool
    right: str
    check: Check
    why: str


@dataclass(frozen=True, slots=True)
class ParameterFault:
    """A rule that the autopilot's parameters violate, and the changes that fix them."""

    rule: ParameterRule
    changes: tuple[str, ...]

    @property
    def reason(self) -> Reason:
        """The reason why nothing is sent or the channel is weak, with the changes needed."""
        code = ReasonCode.PARAMETER_DANGEROUS if self.rule.is_dangerous else ReasonCode.PARAMETER_WEAK
        return Reason(code, {"changes": " and ".join(self.changes), "why": self.rule.why})

    @property
    def brief(self) -> str:
        """The advice for the ground station, in at most forty characters."""
        return f"set {self.changes[0]}{' ...' if self.changes[1:] else ''}"


@dataclass(frozen=True, slots=True)
class Decision:
    """A choice of channel. `missing`: parameters that must be known before the choice can be made. `faults`: violated
    rules of the channel; if the first is dangerous, nothing is sent."""

    choice: ChannelChoice
    missing: tuple[str, ...] = ()
    faults: tuple[ParameterFault, ...] = ()


@dataclass(frozen=True)
class ParameterTable:
    """The table of a firmware's parameters: its `name`, the parameters `deciding` the channel, the `rules` for all
    parameters, and the function that chooses the channel."""

    name: str
    deciding: tuple[str, ...]
    rules: tuple[ParameterRule, ...]
    choose: Callable[[VehicleKind, Parameters], ChannelChoice]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The current names of all parameters, the deciding ones first."""
        return self._join(self.rules)

    @cached_property
    def all_names(self) -> frozenset[str]:
        """The names of all parameters, including their names in other releases."""
        return frozenset(self.names).union(filter(None, map(ALTERNATIVES.get, self.names)))

    def list_needed(self, choice: ChannelChoice) -> tuple[str, ...]:
        """Return the names of the parameters that must be known before anything is sent via the channel of `choice`."""
        return self._join(rule for rule in self.rules if choice.channel in rule.channels)

    def find_faults(self, choice: ChannelChoice, parameters: Parameters) -> tuple[ParameterFault, ...]:
        """Return the rules that `parameters` violate for the channel of `choice`, the dangerous ones first."""
        rules = (rule for rule in self.rules if choice.channel in rule.channels)
        results = (ParameterFault(rule, tuple(rule.check.find_changes(parameters, choice))) for rule in rules)
        faults = (fault for fault in results if fault.changes)
        return tuple(sorted(faults, key=lambda fault: not fault.rule.is_dangerous))

    def decide(self, kind: VehicleKind, parameters: Parameters, is_known: Callable[[str], bool]) -> Decision:
        """Choose the channel. `parameters`: the values read. `is_known` returns whether a parameter's value was read,
        or the autopilot is known to lack that parameter."""
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
    """Make a rule whose wrong values make our positions dangerous to an aircraft that is safe without them:
    nothing may be sent then. `label`: defaults to the name of the first parameter."""
    return replace(recommend(channels, right, check, why, label), is_dangerous=True)


def recommend(channels: tuple[Channel, ...], right: str, check: Check, why: str, label: str = "") -> ParameterRule:
    """Make a rule whose wrong values only make our positions useless or less useful."""
    label = label or check.names[0]
    return ParameterRule(label=label, channels=channels, is_dangerous=False, right=right, check=check, why=why)


def expect(advised: float, *names: str, allows: Callable[[float], bool] | None = None) -> Check:
    """Return a check that advises NAME=`advised` for each parameter whose value `allows` rejects (by default any value
    except `advised`). A parameter that the autopilot lacks counts as correct."""

    def find_changes(parameters: Parameters, _choice: ChannelChoice) -> Iterator[str]:
        for name in names:
            value = read_value(parameters, name, advised)
            if not (value == advised if allows is None else allows(value)):
                yield f"{resolve_name(parameters, name)}={advised:g}"

    return Check(names, find_changes)


def join_checks(*checks: Check) -> Check:
    """Combine checks into one that advises the changes of all."""
    names = tuple(name for check in checks for name in check.names)
    return Check(names, lambda *args: (change for check in checks for change in check.find_changes(*args)))


def make_limit(limit: float) -> Callable[[float], bool]:
    """Return a function that accepts values up to a limit."""
    return lambda value: value <= limit


def is_small_offset(value_m: float) -> bool:
    """Return True if a coordinate of an antenna or camera offset is small enough to be harmless."""
    return abs(value_m) <= MAX_OFFSET_M


def has_bit(value: float, bit: int) -> bool:
    """Return True if a bit mask contains the bit with this value (1, 2, 4, ...)."""
    return bool(int(value) & bit)


def list_axes(prefix: str) -> tuple[str, ...]:
    """Return the parameter names of the three coordinates of a body-frame position."""
    return tuple(f"{prefix}_{axis}" for axis in "XYZ")
