"""Board profiles: hardware, power, and the resources that edgevpr may use. Each is a YAML file in `profiles/`. This
module also detects the board that it runs on. The flight, `edgevpr profile` and `edgevpr service` use it.

`root`: root of the file system with /proc and /sys; tests pass another tree."""

from dataclasses import dataclass, replace
from pathlib import Path

from edgevpr.core import config
from edgevpr.core.errors import ConfigError
from edgevpr.core.files import find_shipped
from edgevpr.core.text import suggest
from edgevpr.core.yamlfile import read_yaml
from edgevpr.power import machine, thermal

_FALLBACK_BOARD = "generic-x86"


@dataclass(frozen=True, slots=True, kw_only=True)
class MachineSpeed:
    """Speed of a machine. `arm64_mips`: million instructions per second of one thread of an aarch64 board (None:
    unknown, or another processor). `verified`: True if `source` measured the figure on this very board."""

    arm64_mips: float | None = config.bounded_key(1, 1_000_000, default=None)
    verified: bool
    source: str


@dataclass(frozen=True, slots=True, kw_only=True)
class Board:
    """Board profile.

    `idle_w`, `full_w`: power at the board's input when idle and with all cores busy (a and a + s in the thesis).
    `verified`: True if `source` measured this power on this very board.
    `rate_hz`: queries per second unless the user sets a rate.
    `cpu_share` (of all cores), `budget_mb` (map index), `memory_max_mb` (whole process): limits of what edgevpr uses.
    `thermal_limit_c`: degrees Celsius at which the board begins to slow down (None: read from its kernel).
    `threads`: number of threads that a network may use.
    `recognised_by`: text in the model name (device tree or firmware) of a machine that is this board (None:
    never)."""

    name: str
    title: str
    recognised_by: str | None
    ram_mb: float = config.bounded_key(64, 4_000_000)
    cores: int = config.bounded_key(1, 1024)
    idle_w: float = config.bounded_key(0, 1000)
    full_w: float = config.bounded_key(0.01, 1000)
    verified: bool
    source: str
    rate_hz: float = config.bounded_key(config.MIN_RATE_HZ, config.MAX_RATE_HZ)
    cpu_share: float = config.bounded_key(0.01, 1)
    budget_mb: float = config.bounded_key(*config.BUDGET_RANGE_MB)
    memory_max_mb: float = config.bounded_key(1, 4_000_000)
    thermal_limit_c: float | None = config.bounded_key(30, 125)
    benchmark_score: MachineSpeed
    threads: int = config.bounded_key(1, 64, default=1)

    def is_this_machine(self, root: Path = Path("/")) -> bool:
        """Return True if this is the profile of the machine that edgevpr runs on."""
        return self.name == _detect_board(root).name or _has_model(self, root)


def list_boards() -> tuple[str, ...]:
    """Return the names of the boards that come with edgevpr."""
    return tuple(sorted(path.stem for path in find_shipped("profiles").glob("*.yaml")))


def load_board(name: str, root: Path = Path("/")) -> Board:
    """Load the profile `name`: "this" (the machine itself), one of `list_boards()`, or the path of a YAML file. Raises
    ConfigError if there is no such board, or if the file is incomplete or invalid."""
    if name == "this":
        return _detect_board(root)
    if name.endswith((".yaml", ".yml")) or "/" in name:
        return _read_board(Path(name))
    if name in list_boards():
        return _read_shipped_board(name)
    names = ["this", *list_boards()]
    hint = suggest(name, names, f"use {', '.join(names)}, or the path of a YAML file.")
    raise ConfigError(f"There is no board `{name}`: {hint}")


def resolve_board(board: Board, source: config.SourceConfig, memory: config.MemoryConfig) -> Board:
    """Return the board with its query rate and index memory replaced by configured values, if any."""
    return replace(board, rate_hz=source.rate_hz or board.rate_hz, budget_mb=memory.budget_mb or board.budget_mb)


def _has_model(board: Board, root: Path) -> bool:
    """Return True if the model name of the machine at `root` contains the text `board.recognised_by`."""
    model = machine.read_model(root)
    return bool(model and board.recognised_by and board.recognised_by.lower() in model.lower())


def _read_shipped_board(name: str) -> Board:
    return _read_board(find_shipped("profiles") / f"{name}.yaml")


def _read_board(path: Path) -> Board:
    board = config.build(Board, {"name": path.stem, **read_yaml(path)}, str(path))
    if board.full_w < board.idle_w:
        raise ConfigError(f"{path}: `full_w` ({board.full_w:g}) is below `idle_w` ({board.idle_w:g}): correct them.")
    if not board.budget_mb <= board.memory_max_mb <= board.ram_mb:
        raise ConfigError(
            f"{path}: `budget_mb` ({board.budget_mb:g}) must fit in `memory_max_mb` ({board.memory_max_mb:g}), and "
            f"that in `ram_mb` ({board.ram_mb:g}): correct them."
        )
    return board


def _detect_board(root: Path) -> Board:
    """Return the profile of this machine's board, or else generic-x86, with the cores and memory of this machine."""
    model = machine.read_model(root)
    boards = map(_read_shipped_board, list_boards() if model else ())
    detected = next((board for board in boards if _has_model(board, root)), None)
    profile = detected or _read_shipped_board(_FALLBACK_BOARD)
    title = profile.title
    if model and not detected:
        title = f"{model} has no profile, using the figures of {_FALLBACK_BOARD}"
    ram_mb = machine.read_ram_mb(root)
    # Scale the profile's memory limits to the machine's real memory; a cgroup may allow less.
    memory_max_mb = min(profile.memory_max_mb / profile.ram_mb * ram_mb, machine.read_ram_limit_mb(root))
    # The power model counts all cores of the machine, so a CPU quota reduces `cpu_share` instead of `cores`.
    cores = machine.count_cores_online(root)
    cpu_share = min(profile.cpu_share, machine.count_usable_cores(root) / cores)
    return replace(
        profile,
        title=f"this machine ({title})",
        ram_mb=ram_mb,
        cores=cores,
        cpu_share=cpu_share,
        thermal_limit_c=profile.thermal_limit_c or thermal.read_limit_c(root),
        threads=max(1, min(profile.threads, round(cpu_share * cores))),
        budget_mb=memory_max_mb * profile.budget_mb / profile.memory_max_mb,
        memory_max_mb=memory_max_mb,
    )
