"""Rules of the house that no linter knows."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

PACKAGE = Path(__file__).parents[1] / "edgevpr"


def classes() -> Iterator[tuple[str, ast.ClassDef]]:
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.ClassDef):
                yield f"{path.relative_to(PACKAGE)}: {node.name}", node


def test_what_has_more_than_four_fields_is_made_by_keyword():
    positional = []
    for name, node in classes():
        made = [ast.unparse(each) for each in node.decorator_list if "dataclass" in ast.unparse(each)]
        fields = [each for each in node.body if isinstance(each, ast.AnnAssign) and "ClassVar" not in ast.unparse(each)]
        if made and len(fields) > 4 and "kw_only=True" not in made[0]:
            positional.append(name)
        for each in node.body:
            if isinstance(each, ast.FunctionDef) and each.name == "__init__" and len(each.args.args) > 5:
                positional.append(name)
    assert not positional
