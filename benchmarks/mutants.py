"""Mutants of the decisions that keep a wrong position from an aircraft.

Cosmic Ray changes one operator or number at a time, and the tests that hold the module run. A mutant that no test
notices survives. `benchmarks/mutants.yaml` names the modules, their tests, the changes, and why a survivor may live.
"""

# A mutant is only in the memory of a process forked for it: no file ever holds one, also if the run is killed, and what
# the module imports is loaded once. What was killed is kept in mutants_work/.

import json
import os
import re
import resource
import sys
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from importlib import util
from pathlib import Path

import base
import grimp
import pytest
import yaml
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator

PLAN = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text())
WORK = base.REPOSITORY / "mutants_work"
JOBS = int(os.environ.get("JOBS", 2))
MAX_CPU_S = 60  # of the tests of one mutant; one that takes longer counts as killed


def main() -> int:
    WORK.mkdir(exist_ok=True)
    for module in sys.argv[1:] or PLAN["modules"]:
        if run_forked(lambda module=module: run_module(module)):
            return 1
    write_page()
    return 0


def run_forked(task: Callable[[], int]) -> int:
    """Run a task in a process of its own, and return its status."""
    return os.waitpid(fork(task), 0)[1]


def fork(task: Callable[[], int]) -> int:
    """Run a task that returns an exit code in a process of its own, and return the process's id."""
    sys.stdout.flush()
    if pid := os.fork():
        return pid
    try:
        os._exit(task())
    except BaseException:  # a forked process must not go on as this one
        traceback.print_exc()
        os._exit(1)


def kept_outcomes(module: str) -> Path:
    """Return the file that says of each change of a module whether it was killed."""
    return WORK / Path(module).with_suffix(".json").name


def list_mutants(source: str) -> Iterator[tuple[str, str]]:
    """Yield the mutants of a module: the change of its line, and the whole source."""
    seen = Counter[str]()
    for name in PLAN["operators"]:
        operator = get_operator(f"core/{name}")()
        positions = sum(len(list(operator.mutation_positions(node))) for node in ast_nodes(get_ast(source)))
        for occurrence in range(positions):
            mutant = mutate_code(source, operator, occurrence)
            lines = zip(source.splitlines(), mutant.splitlines(), strict=True)
            change = " => ".join(line.strip() for line in next(pair for pair in lines if pair[0] != pair[1]))
            if not re.match(PLAN["unchanged"], change):
                seen[change] += 1
                yield f"{change} ({seen[change]})", mutant


def run_module(module: str) -> int:
    """Run the tests of a module on each of its mutants, and keep which ones were killed."""
    source, kept = (base.REPOSITORY / module).read_text(), kept_outcomes(module)
    name = module.removesuffix(".py").replace("/", ".")
    pytest.main(["--collect-only", "-qq", "-p", "no:xdist", *PLAN["modules"][module]])  # loads all that is needed
    forget(name)
    if run_forked(lambda: run_tests(module, name, source, is_quiet=False)):
        return 1
    before = json.loads(kept.read_text()) if kept.exists() else {}
    mutants = dict(list_mutants(source))
    killed = {change: before.get(change) for change in mutants}
    waiting, running = [change for change in mutants if not killed[change]], dict[int, str]()
    while waiting or running:
        while waiting and len(running) < JOBS:
            change = waiting.pop()
            running[fork(lambda source=mutants[change]: run_tests(module, name, source))] = change
        pid, status = os.wait()
        killed[running.pop(pid)] = bool(status)
        kept.write_text(json.dumps(killed, indent=0))
    kept.write_text(json.dumps(killed, indent=0))
    print(f"{module}: {len(killed)} mutants, {sum(killed.values())} killed", flush=True)
    return 0


def forget(name: str) -> None:
    """Unload a module, all that import it, and the tests: they are to be loaded with the mutant."""
    users = {name, *grimp.build_graph("edgevpr", cache_dir=None).find_downstream_modules(name)}
    for other, module in list(sys.modules.items()):
        path = getattr(module, "__file__", None) or ""
        if other in users or path.startswith(str(base.REPOSITORY / "tests")):
            parent, _, child = other.rpartition(".")
            if parent in sys.modules:
                vars(sys.modules[parent]).pop(child, None)
            del sys.modules[other]


def run_tests(module: str, name: str, source: str, is_quiet: bool = True) -> int:
    """Run the tests of a module with another source, and return the exit code."""
    resource.setrlimit(resource.RLIMIT_CPU, (MAX_CPU_S, MAX_CPU_S))
    if is_quiet:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        os.dup2(1, 2)
    mutant = util.module_from_spec(util.find_spec(name))
    parent, _, child = name.rpartition(".")
    sys.modules[name] = mutant
    setattr(sys.modules[parent], child, mutant)
    exec(compile(source, module, "exec"), mutant.__dict__)
    return pytest.main(["-x", "-p", "no:xdist", *PLAN["modules"][module]])


def write_page() -> None:
    """Write benchmarks/results/mutants.md."""
    rows, survivors = [], []
    for module in PLAN["modules"]:
        kept = kept_outcomes(module)
        killed = json.loads(kept.read_text()) if kept.exists() else {}
        for change in (change for change, is_killed in killed.items() if not is_killed):
            after = change.rpartition(" (")[0].partition(" => ")[2]
            reasons = (why for why, lines in PLAN["survivors"].items() if after in lines)
            survivors.append({"module": Path(module).name, "mutant": after, "why": next(reasons, "**a gap**")})
        rows.append({"module": module, "mutants": len(killed), "killed": sum(killed.values())})
    total = {name: sum(row[name] for row in rows) for name in ("mutants", "killed")}
    rows = [{**row, "share": row["killed"] / max(row["mutants"], 1)} for row in [*rows, {"module": "all", **total}]]
    columns = {"module": "{module}", "mutants": "{mutants}", "killed": "{killed}", "share": "{share:.1%}"}
    listed = {"module": "{module}", "survivor": "`{mutant}`", "why it may live": "{why}"}
    parts = ["# Mutants", base.told(__doc__), base.table(rows, columns), base.table(survivors, listed, left=3)]
    page = "\n\n".join([*parts, base.made_line(base.made_by(), "make mutants")])
    (base.RESULTS / "mutants.md").write_text(page + "\n")


if __name__ == "__main__":
    base.run(main, opencv_threads=None)
