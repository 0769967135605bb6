"""Mutation tests of the decisions that keep wrong positions from the aircraft.

Cosmic Ray changes one operator or number of a module at a time, and the tests of the module run on this mutant. A
mutant survives if no test fails. `benchmarks/mutants.yaml` lists modules, tests, changes, and acceptable survivors.
"""

# Each mutant is compiled in a forked process and never written to a file, so a killed run leaves the source as it was,
# and the module's imports are loaded only once. mutants_work/ records which mutants were killed.

import json
import os
import re
import resource
import sys
from collections import Counter
from collections.abc import Iterator
from importlib import util
from multiprocessing import connection, get_context
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
MAX_PROCESSES = int(os.environ.get("JOBS", 2))
MAX_CPU_S = 60  # for the tests of one mutant; a mutant that takes longer counts as killed
FORK = get_context("fork")


def main() -> int:
    for module in sys.argv[1:] or PLAN["modules"]:
        process = FORK.Process(target=run_module, args=(module,))
        process.start()
        process.join()
        if process.exitcode:
            return 1
    write_page()
    return 0


def list_mutants(source: str) -> Iterator[tuple[str, str]]:
    """Yield the mutants of a module: the changed line as a text "before => after (number)", and the whole source."""
    occurrences = Counter[str]()
    for name in PLAN["operators"]:
        operator = get_operator(f"core/{name}")()
        positions = sum(len(list(operator.mutation_positions(node))) for node in ast_nodes(get_ast(source)))
        for index in range(positions):
            mutant = mutate_code(source, operator, index)
            lines = zip(source.splitlines(), mutant.splitlines(), strict=True)
            change = " => ".join(line.strip() for line in next(pair for pair in lines if pair[0] != pair[1]))
            if not re.match(PLAN["unchanged"], change):
                occurrences[change] += 1
                yield f"{change} ({occurrences[change]})", mutant


def run_module(module: str) -> None:
    """Run the tests of a module on each of its mutants, and write to WORK which mutants they killed."""
    name, source = module.removesuffix(".py").replace("/", "."), (base.REPOSITORY / module).read_text()
    path = WORK / f"{Path(module).stem}.json"
    pytest.main(["--collect-only", "-qq", "-p", "no:xdist", *PLAN["modules"][module]])  # to load every import
    unload_module(name)
    mutants, previous = dict(list_mutants(source)), json.loads(path.read_text()) if path.exists() else {}
    killed = {"": False} | {change: previous.get(change, False) for change in mutants}  # "": the unchanged module
    waiting, running = [change for change in reversed(killed) if not killed[change]], {}
    while waiting or running:
        while waiting and len(running) < MAX_PROCESSES:
            change = waiting.pop()
            process = FORK.Process(target=run_tests, args=(module, name, mutants.get(change, source)))
            process.start()
            running[process.sentinel] = process, change
        for sentinel in connection.wait(running):
            process, change = running.pop(sentinel)
            process.join()
            killed[change] = process.exitcode != 0
        if killed[""]:
            sys.exit(f"{module}: the tests fail on the unchanged module")
        WORK.mkdir(exist_ok=True)
        path.write_text(json.dumps(killed, indent=0))
    print(f"{module}: {len(mutants)} mutants, {sum(killed.values())} killed", flush=True)


def unload_module(name: str) -> None:
    """Unload a module, every module that imports it, and the tests, so that they are loaded again with the mutant."""
    importers = {name, *grimp.build_graph("edgevpr", cache_dir=None).find_downstream_modules(name)}
    for loaded, module in list(sys.modules.items()):
        path = getattr(module, "__file__", None) or ""
        if loaded in importers or path.startswith(str(base.REPOSITORY / "tests")):
            parent, _, child = loaded.rpartition(".")
            if parent in sys.modules:
                vars(sys.modules[parent]).pop(child, None)
            del sys.modules[loaded]


def run_tests(module: str, name: str, source: str) -> None:
    """Run the tests of a module with `source` in its place, and exit with the exit code of pytest."""
    resource.setrlimit(resource.RLIMIT_CPU, (MAX_CPU_S, MAX_CPU_S))
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
    os.dup2(1, 2)
    mutant = util.module_from_spec(util.find_spec(name))
    parent, _, child = name.rpartition(".")
    sys.modules[name] = mutant
    setattr(sys.modules[parent], child, mutant)
    exec(compile(source, module, "exec"), mutant.__dict__)
    sys.exit(pytest.main(["-x", "-p", "no:xdist", *PLAN["modules"][module]]))


def write_page() -> None:
    """Write benchmarks/results/mutants.md."""
    rows, survivors = [], {why: [] for why in PLAN["survivors"]}
    for module in PLAN["modules"]:
        killed = json.loads((WORK / f"{Path(module).stem}.json").read_text())
        del killed[""]
        for change in (change for change, is_killed in killed.items() if not is_killed):
            after = change.rpartition(" (")[0].partition(" => ")[2]
            reasons = (why for why, parts in PLAN["survivors"].items() if any(part in after for part in parts))
            survivors.setdefault(next(reasons, "Gaps"), []).append(f"- {Path(module).name}: `{after}`")
        rows.append({"module": module, "mutants": len(killed), "killed": sum(killed.values())})
    total = {name: sum(row[name] for row in rows) for name in ("mutants", "killed")}
    rows = [{**row, "share": row["killed"] / row["mutants"]} for row in [*rows, {"module": "all", **total}]]
    columns = {"module": "{module}", "mutants": "{mutants}", "killed": "{killed}", "share": "{share:.1%}"}
    parts = ["# Mutants", base.strip_title(__doc__), base.format_table(rows, columns), "## Survivors"]
    parts += [f"{why}:\n\n" + "\n".join(lines) for why, lines in survivors.items() if lines]
    page = "\n\n".join([*parts, base.format_origin(base.describe_run(), "make mutants")])
    (base.RESULTS / "mutants.md").write_text(page + "\n")


if __name__ == "__main__":
    base.run(main, opencv_threads=None)
