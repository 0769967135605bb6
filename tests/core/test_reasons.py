"""Reasons: the table of sentences is the only place that has them, and every reason gives the parameters of its own."""

import ast
from pathlib import Path

import pytest

import edgevpr
from edgevpr.core.reasons import Reason, ReasonCode, read_reason

PACKAGE = Path(edgevpr.__file__).parent


def parse_package():
    """The syntax trees of all modules but the table's own."""
    for path in sorted(PACKAGE.rglob("*.py")):
        if path != PACKAGE / "core/reasons.py":
            yield path, ast.parse(path.read_text("utf-8"))


@pytest.mark.parametrize(
    ("code", "parameters", "sentence"),
    [
        ("LOW_SCORE", {"score": 0.05, "needed": 0.1}, "not similar enough to any place: score 0.050, 0.100 needed"),
        ("UNUSABLE", {"problem": "1.png is cut short."}, "1.png is cut short."),
        (
            "LOW_CONFIDENCE",
            {
                "confidence": 0.5,
                "needed": 0.9995,
                "regions_ratio": 2.0,
                "regions_share": 0.25,
                "landmarks": 7,
                "track": None,
            },
            "confidence too low: confidence 50.0 %, 1 in 2,000 wrong needed: 2.0 times as many regions agree as for "
            "the runner-up (25%), 7 landmarks agree",
        ),
        ("LOW_SCORE", {"score": "damaged", "needed": 0.1}, "not similar enough to any place"),
    ],
)
def test_reason_is_a_sentence_without_what_is_unknown(code, parameters, sentence):
    reason = Reason(ReasonCode[code], parameters)
    assert str(reason) == sentence


def test_reason_codes_are_all_different():
    assert len(ReasonCode.__members__) == len(list(ReasonCode)), "members with equal texts would be one"


def test_read_reason_gives_what_was_written_and_nothing_else():
    reason = Reason(ReasonCode.NOT_MEMORABLE, {"measure": "entropy", "score": 0.25, "needed": None})
    assert read_reason(reason.fields()) == Reason(reason.code, {"measure": "entropy", "score": 0.25})
    for damaged in (None, "not memorable", 7, {"code": "GONE", "parameters": {}}, {"code": "LOW_SCORE"}):
        assert read_reason(damaged) is None
    nested = {"code": "LOW_SCORE", "parameters": {"score": [1], "needed": True}}
    assert read_reason(nested) == Reason(ReasonCode.LOW_SCORE, {})


def test_reasons_are_given_the_parameters_of_their_sentences():
    wrong = []
    for path, tree in parse_package():
        for node in ast.walk(tree):
            match node:
                case ast.Call(
                    func=ast.Name(id="Reason"), args=[ast.Attribute(value=ast.Name(id="ReasonCode"), attr=code), *given]
                ):
                    keys = given[0].keys if given and isinstance(given[0], ast.Dict) else []
                case ast.Call(func=ast.Name(id="_refuse"), args=[ast.Attribute(attr=code)], keywords=keywords):
                    given, keys = [], [ast.Constant(keyword.arg) for keyword in keywords]
                case _:
                    continue
            names = {key.value for key in keys if key}
            is_whole = None not in keys and not (given and not isinstance(given[0], ast.Dict))
            expected = ReasonCode[code].parameters
            if not names <= expected or (is_whole and names != expected):
                wrong.append((path.name, node.lineno, code, names))
    assert wrong == []


def test_no_module_takes_a_sentence_apart():
    """Neither a pattern nor a method of text is applied to a reason, nor is one compared with text."""
    methods = {"startswith", "endswith", "split", "partition", "replace", "find", "match", "search", "sub", "count"}
    found = []
    for path, tree in parse_package():
        for node in ast.walk(tree):
            match node:
                case ast.Call(func=ast.Attribute(value=of, attr=name), args=given) if name in methods:
                    parts = [of, *given]
                case ast.Compare(left=left, comparators=others) if any(
                    isinstance(each, ast.Constant) and isinstance(each.value, str) for each in (left, *others)
                ):
                    parts = [left, *others]
                case _:
                    continue
            if any(_is_reason(part) for part in parts):
                found.append((path.name, node.lineno))
    assert found == []


def _is_reason(node):
    """Tell whether an expression is a reason, or its sentence, by its name."""
    match node:
        case ast.Name(id=name) | ast.Attribute(attr=name) | ast.Subscript(slice=ast.Constant(value=name)):
            return name in ("reason", "why", "objection")
        case ast.Call(func=ast.Name(id="str"), args=[inner]):
            return _is_reason(inner)
    return False
