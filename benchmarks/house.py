"""How large the house is: `python benchmarks/house.py [ROOT [ROOM ...]]`.

Prints the files and lines of each room of edgevpr/ and the longest function; what breaks a habit of the house (of the
rooms that are named, or of all): a file of fewer than 40 or more than 350 lines, a function of more than 60 lines or 7
parameters, a class name that is there twice, a file name three times; and the lines of benchmarks/ and of each folder
of tests/, with its assertions on prose (three words or more), which hold a sentence and not a behaviour.
"""

import ast
import re
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

FEWEST_LINES, MOST_LINES, MOST_FUNCTION_LINES, MOST_PARAMETERS = 40, 350, 60, 7
_PROSE_WORDS = 3


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
    count_tests(root)


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


def count_tests(root: Path) -> None:
    """Print the lines of the benchmarks and of the folders of tests, and the assertions on prose in these."""
    benchmarks = list((root / "benchmarks").rglob("*.py"))
    print(f"benchmarks: {len(benchmarks)} files, {sum(map(lines_of, benchmarks))} lines")
    lines: Counter[str] = Counter()
    prose: Counter[str] = Counter()
    for path in (root / "tests").rglob("*.py"):
        folder = str(path.relative_to(root).parent)
        lines[folder] += lines_of(path)
        prose[folder] += sum(map(asserts_prose, ast.walk(ast.parse(path.read_text("utf-8")))))
    for folder in sorted(lines):
        print(f"{folder:34}{lines[folder]:8}   assertions on prose: {prose[folder]}")
    print(f"{'tests':34}{lines.total():8}   assertions on prose: {prose.total()}")


def asserts_prose(node: ast.AST) -> bool:
    """Tell whether a node asks for a sentence: `match="..."`, or a comparison with one in an assertion."""
    if isinstance(node, ast.keyword):
        return node.arg == "match" and is_prose(node.value)
    compared = (
        [each for each in ast.walk(node) if isinstance(each, ast.Compare)] if isinstance(node, ast.Assert) else []
    )
    return any(is_prose(side) for each in compared for side in (each.left, *each.comparators))


def is_prose(node: ast.expr) -> bool:
    """Tell whether a string, or a sum of strings, has three words or more."""
    sides = [node.left, node.right] if isinstance(node, ast.BinOp) else [node]
    parts = [part for side in sides for part in (side.values if isinstance(side, ast.JoinedStr) else [side])]
    texts = [part.value for part in parts if isinstance(part, ast.Constant) and isinstance(part.value, str)]
    return len(re.findall(r"[A-Za-z]{2,}", " ".join(texts))) >= _PROSE_WORDS


if __name__ == "__main__":
    main()
