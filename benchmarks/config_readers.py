"""Compare edgevpr's own strict reader of configurations with well-kept libraries: what an import takes, and what a user
reads who made a mistake. `python benchmarks/config_readers.py` prints a Markdown table of both.

The libraries are none of edgevpr's dependencies: pip install msgspec cattrs pydantic
"""

import dataclasses
import statistics
import subprocess
import sys
from typing import Annotated

from edgevpr.core.config import bounded, build
from edgevpr.core.errors import ConfigError

STARTS = 7
IMPORTS = {
    "edgevpr.core.config": "import edgevpr.core.config",
    "msgspec": "import msgspec",
    "cattrs": "import cattrs",
    "pydantic": "from pydantic import TypeAdapter",
}
# A process with what the runtime has anyway; what the import adds to its time and to its resident memory.
PROBE = """
import dataclasses, difflib, types, typing, yaml, time
def resident_mb():
    return int(open("/proc/self/statm").read().split()[1]) * 4096 / 1e6
before_mb, begin_s = resident_mb(), time.perf_counter()
{statement}
print(time.perf_counter() - begin_s, resident_mb() - before_mb)
"""
MISTAKES = {
    "out of range": {"source": {"rate_hz": 1000}},
    "wrong type": {"source": {"rate_hz": "fast"}},
    "unknown key": {"source": {"rate_hertz": 3.0}},
    "no section": {"source": "camera"},
}


@dataclasses.dataclass(frozen=True)
class Source:
    rate_hz: float = bounded(0.01, 60)


@dataclasses.dataclass(frozen=True)
class Config:
    source: Source


def with_own(mapping: dict) -> None:
    build(Config, mapping, "config.yaml")


def with_msgspec(mapping: dict) -> None:
    import msgspec

    class Source(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
        rate_hz: Annotated[float, msgspec.Meta(ge=0.01, le=60)]

    class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
        source: Source

    msgspec.convert(mapping, Config)


def with_cattrs(mapping: dict) -> None:
    import cattrs

    try:
        cattrs.Converter(forbid_extra_keys=True).structure(mapping, Config)
    except Exception as error:
        raise ValueError("; ".join(cattrs.transform_error(error))) from error


def with_pydantic(mapping: dict) -> None:
    from pydantic import BaseModel, ConfigDict, Field

    class Source(BaseModel):
        model_config = ConfigDict(extra="forbid", strict=True)
        rate_hz: Annotated[float, Field(ge=0.01, le=60)]

    class Config(BaseModel):
        model_config = ConfigDict(extra="forbid", strict=True)
        source: Source

    Config.model_validate(mapping)


READERS = {"edgevpr.core.config": with_own, "msgspec": with_msgspec, "cattrs": with_cattrs, "pydantic": with_pydantic}


def import_cost(statement: str) -> tuple[float, float]:
    """Milliseconds and MB that an import adds to a process, medians of `STARTS` processes."""
    taken = []
    for _ in range(STARTS):
        done = subprocess.run([sys.executable, "-c", PROBE.format(statement=statement)], capture_output=True, text=True)
        done.check_returncode()
        taken.append([float(word) for word in done.stdout.split()])
    seconds, mb = zip(*taken, strict=True)
    return 1000 * statistics.median(seconds), statistics.median(mb)


def said(name: str, mapping: dict) -> str:
    """Return the message of a reader for a mapping with a mistake, in one line."""
    try:
        READERS[name](mapping)
    except (ConfigError, ValueError, TypeError) as error:
        return " ".join(str(error).split()).replace("|", "\\|")
    return "taken as it is"


def main() -> None:
    """Print what each reader that is installed takes and says."""
    print(f"| reader | import ms | MB | {' | '.join(MISTAKES)} |\n|---|---|---|{'---|' * len(MISTAKES)}")
    for name, statement in IMPORTS.items():
        try:
            __import__(name)
        except ImportError:
            print(f"| {name} | not installed |")
            continue
        milliseconds, mb = import_cost(statement)
        messages = " | ".join(said(name, mapping) for mapping in MISTAKES.values())
        print(f"| {name} | {milliseconds:.0f} | {mb:.1f} | {messages} |")


if __name__ == "__main__":
    main()
