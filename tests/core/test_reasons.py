"""Reasons: the table of sentences is the only place that has them, and every reason gives the parameters of its own."""

import ast
from pathlib import Path

import pytest

import edgevpr
from edgevpr.core.reasons import Reason, ReasonCode, read_reason
from edgevpr.runtime.service.findingcodes import FindingCode

PACKAGE = Path(edgevpr.__file__).parent
TABLES = {"ReasonCode": ReasonCode, "FindingCode": FindingCode}
CODES = [*ReasonCode, *FindingCode]


def parse_package():
    """The syntax trees of all modules but those of the tables."""
    for path in sorted(PACKAGE.rglob("*.py")):
        if path not in (PACKAGE / "core/reasons.py", PACKAGE / "runtime/service/findingcodes.py"):
            yield path, ast.parse(path.read_text("utf-8"))


CONFIDENCE = {"confidence": 0.5, "min_confidence": 0.9995, "regions_ratio": 2.0, "regions_share": 0.25}


@pytest.mark.parametrize(
    ("code", "parameters", "sentence"),
    [
        ("LOW_SCORE", {"score": 0.05, "min_score": 0.1}, "not similar enough to any place: score 0.050, 0.100 needed"),
        ("UNUSABLE", {"problem": "1.png is truncated."}, "1.png is truncated."),
        (
            "LOW_CONFIDENCE",
            CONFIDENCE | {"track_confidence": None, "landmarks": 7},
            "confidence too low: confidence 50.0 %, 1 in 2,000 wrong needed: 2.0 times as many regions agree as for "
            "the runner-up (25%), 7 landmarks agree",
        ),
        ("LOW_SCORE", {"score": "damaged", "min_score": 0.1}, "not similar enough to any place"),
        ("FILTER_READY", {"flags": 0x33F}, "the EKF has attitude and position (flags 0x33f)"),
        ("LOG_NOT_A_FILE", {"path": "/"}, "/ is not a file in an existing folder: correct `log: {path: ...}`"),
        (
            "LINK_OPENED_DRY",
            {"address": "tcp:10.0.0.2:5760", "system": 1, "key": None},
            "tcp:10.0.0.2:5760, autopilot of system 1, dry run: no fix is sent",
        ),
    ],
)
def test_reason_sentence_omits_unknown_parameters(code, parameters, sentence):
    assert [str(Reason(each, parameters)) for each in CODES if each.name == code] == [sentence]


def test_reason_codes_are_all_different():
    names = [name for table in TABLES.values() for name in table.__members__]
    assert len(set(names)) == len(names) == len(CODES), "members with equal texts would be one"


def test_read_reason_reverses_fields_and_rejects_everything_else():
    reason = Reason(ReasonCode.NOT_MEMORABLE, {"measure": "entropy", "score": 0.25, "min_score": None})
    assert read_reason(reason.fields()) == Reason(reason.code, {"measure": "entropy", "score": 0.25})
    for damaged in (None, "not memorable", 7, {"code": "GONE", "parameters": {}}, {"code": "LOW_SCORE"}):
        assert read_reason(damaged) is None
    nested = {"code": "LOW_SCORE", "parameters": {"score": [1], "min_score": True}}
    assert read_reason(nested) == Reason(ReasonCode.LOW_SCORE, {})


def test_reasons_are_given_the_parameters_of_their_sentences():
    wrong, used = [], set()
    for path, tree in parse_package():
        for node in ast.walk(tree):
            match node:
                case ast.Call(func=ast.Name(id="Reason"), args=[code, *given]):
                    keys = given[0].keys if given and isinstance(given[0], ast.Dict) else []
                    is_whole = None not in keys and not (given and not isinstance(given[0], ast.Dict))
                case (
                    ast.Call(func=ast.Name(id="_refuse"), args=[code, *_], keywords=keywords)
                    | ast.Call(func=ast.Name(id="fine" | "wrong"), args=[_, code, *_], keywords=keywords)
                ):
                    keys = [keyword.arg and ast.Constant(keyword.arg) for keyword in keywords]
                    is_whole = None not in keys
                case ast.Attribute(value=ast.Name(id="ReasonCode" | "FindingCode"), attr=name):
                    used.add(name)
                    continue
                case _:
                    continue
            match code:
                case ast.Attribute(value=ast.Name(id=table), attr=name) if table in TABLES:
                    names, expected = {key.value for key in keys if key}, TABLES[table][name].parameters
                    if not names <= expected or (is_whole and names != expected):
                        wrong.append((path.name, node.lineno, name, names))
    assert wrong == []
    assert {code.name for code in CODES} - used == {"NOT_SEARCHED"}, "which `reasons` itself uses"


def test_modules_never_parse_the_sentence_of_a_reason():
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
            return name in ("reason", "why", "objection", "problem", "note", "texts", "warnings")
        case ast.Call(func=ast.Name(id="str"), args=[inner]):
            return _is_reason(inner)
    return False
