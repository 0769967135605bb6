"""How large the house is: `python benchmarks/house.py [ROOT [ROOM ...]]`.

Prints the files and lines of each room of edgevpr/ and the longest function; what breaks a habit of the house (of the
rooms that are named, or of all): a file of fewer than 40 or more than 350 lines, a function of more than 60 lines or 7
parameters, a class name that is there twice, a file name three times; and the lines of tests/ and of benchmarks/.
"""

import ast
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

FEWEST_LINES, MOST_LINES, MOST_FUNCTION_LINES, MOST_PARAMETERS = 40, 350, 60, 7


def main() -> None:
    root, rooms = Path(sys.argv[1] if len(sys.argv) > 1 else ".").resolve(), sys.argv[2:]
    paths = sorted((root / "edgevpr").rglob("*.py"))
    count_rooms(root / "edgevpr", paths)
    for path in paths:
        if not rooms or str(path.relative_to(root / "edgevpr")).startswith(tuple(rooms)):
            for broken in habits_broken(path):
                print(f"{path.relative_to(root)}: {broken}")
    for twice in names_twice(root / "edgevpr", paths):
        print(twice)
    for name in ("tests", "benchmarks"):
        print(f"{name:34}{sum(map(lines_of, (root / name).rglob('*.py'))):14}")


def lines_of(path: Path) -> int:
    return path.read_text("utf-8").count("\n")


def functions(path: Path) -> Iterator[tuple[str, int, int]]:
    """Yield the name, the lines and the parameters (without self) of each function of a file."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            given = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
            is_method = bool(node.args.args) and node.args.args[0].arg in ("self", "cls")
            yield node.name, (node.end_lineno or 0) - node.lineno + 1, len(given) - is_method


def count_rooms(package: Path, paths: list[Path]) -> None:
    """Print a line for each room, and one for all."""
    files: Counter[str] = Counter()
    lines: Counter[str] = Counter()
    for path in paths:
        room = str(path.relative_to(package).parent)
        lines[room] += lines_of(path)
        files[room] += path.name not in ("__init__.py", "__main__.py") and lines_of(path) > 0
    print(f"{'room':34}{'files':>6}{'lines':>8}")
    for room in sorted(lines):
        print(f"{room:34}{files[room]:6}{lines[room]:8}")
    long, name = max(
        (size, f"{path.relative_to(package)}:{name}") for path in paths for name, size, _ in functions(path)
    )
    print(f"{'edgevpr':34}{files.total():6}{lines.total():8}   longest function: {long} lines, {name}")


def habits_broken(path: Path) -> Iterator[str]:
    """Yield what of a file is too short, too long or takes too much."""
    if path.name not in ("__init__.py", "__main__.py") and not FEWEST_LINES <= lines_of(path) <= MOST_LINES:
        yield f"{lines_of(path)} lines"
    for name, size, parameters in functions(path):
        if size > MOST_FUNCTION_LINES:
            yield f"{name}: {size} lines"
        if parameters > MOST_PARAMETERS:
            yield f"{name}: {parameters} parameters"


def names_twice(package: Path, paths: list[Path]) -> Iterator[str]:
    """Yield the classes whose name is there twice, and the names of files that are there three times."""
    classes = defaultdict(list)
    for path in paths:
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ClassDef):
                classes[node.name].append(str(path.relative_to(package)))
    yield from (f"class {name}: {', '.join(where)}" for name, where in classes.items() if len(where) > 1)
    files = Counter(path.name for path in paths if path.name != "__init__.py")
    yield from (f"file {name}: {count} times" for name, count in files.items() if count > 2)


if __name__ == "__main__":
    main()
