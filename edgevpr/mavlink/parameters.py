"""Rules about the autopilot's parameters: the form of one row of the table that says, for every parameter that changes
what our messages do, which values are right, and what happens with others.

The rows stand in `ardupilot_parameters` and `px4_parameters`. They serve the flight, which sends nothing while a
dangerous row is broken, `edgevpr doctor`, and the page docs/reference/parameters.md.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TypeAlias

from edgevpr.mavlink.channel import OLD_NAMES, Channel, Choice, own_name, read_value

Parameters: TypeAlias = Mapping[str, float]
FindChanges = Callable[[Parameters, Choice], Iterable[str]]

# ARMING_SKIPCHK takes the place of ARMING_CHECK after ArduPilot 4.6: it names the checks to leave out.
_ALTERNATIVES = {**OLD_NAMES, "ARMING_CHECK": "ARMING_SKIPCHK"}
MAX_OFFSET_M = 1.0  # of an antenna or a camera: a position that is moved by more is wrong by more than a good fix
MAX_DELAY_MS = 50.0  # we send the position of the moment, so at 25 m/s this is wrong by 1.2 m


@dataclass(frozen=True, slots=True, kw_only=True)
class ParameterRule:
    """A row of the table.
    - `label`: the parameters as a pilot looks for them; `names`: those that `find_changes` reads.
    - `channels`: those that it matters for; `right`: the values that are right, in words.
    - `is_dangerous`: with a wrong value an aircraft can be lost that would be fine alone, so nothing may be sent. Else
      a wrong value only makes us useless, or weak. `why`: what happens then, in a sentence.
    - `find_changes`: takes all values that were read, and the channel chosen for them. Returns the changes, such as
      "GPS_PRIMARY=0"; none if the values are right."""

    label: str
    names: tuple[str, ...]
    channels: tuple[Channel, ...]
    right: str
    is_dangerous: bool
    why: str
    find_changes: FindChanges


@dataclass(frozen=True, slots=True)
class ParameterFault:
    """A rule that the autopilot's parameters break, and the changes that put it right."""

    rule: ParameterRule
    changes: tuple[str, ...]

    @property
    def advice(self) -> str:
        return f"set {' and '.join(self.changes)}"

    @property
    def brief(self) -> str:
        """The advice for a ground station, which shows forty letters."""
        return f"set {self.changes[0]}{' ...' if self.changes[1:] else ''}"


def find_faults(rules: Iterable[ParameterRule], choice: Choice, parameters: Parameters) -> tuple[ParameterFault, ...]:
    """Return the rules that `parameters` break for the channel of `choice`, the dangerous ones first."""
    ours = (rule for rule in rules if choice.channel in rule.channels)
    found = (ParameterFault(rule, tuple(rule.find_changes(parameters, choice))) for rule in ours)
    return tuple(sorted((fault for fault in found if fault.changes), key=lambda fault: not fault.rule.is_dangerous))


def name_alternative(name: str) -> str | None:
    """Return the name under which another release has this parameter, or one in its place; None if there is none."""
    return _ALTERNATIVES.get(name)


def demand(right: float, *names: str, allows: Callable[[float], bool] | None = None) -> FindChanges:
    """Return a function that advises NAME=`right` for each of the parameters whose value `allows` refuses (by default
    any value but `right`). A parameter that the autopilot does not have is right."""

    def find_changes(parameters: Parameters, _choice: Choice) -> Iterator[str]:
        for name in names:
            value = read_value(parameters, name, right)
            if not (value == right if allows is None else allows(value)):
                yield f"{own_name(parameters, name)}={right:g}"

    return find_changes


def has_bit(value: float, bit: int) -> bool:
    """Return True if a bit mask contains the bit of this value (1, 2, 4, ...)."""
    return bool(int(value) & bit)


def name_axes(prefix: str) -> tuple[str, ...]:
    """Return the names of the three coordinates of a position in the airframe."""
    return tuple(f"{prefix}_{axis}" for axis in "XYZ")
