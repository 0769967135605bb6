"""Holds what `--json` prints to its schema, docs/reference/json-output.yaml, in every test that calls the program."""

import json
import sys
from functools import cache
from pathlib import Path
from typing import Any

import yaml

SCHEMA = Path(__file__).parents[1] / "docs/reference/json-output.yaml"


@cache
def read_schema() -> dict[str, Any]:
    """The schema, strictly: every field is documented, and is there where it is promised."""
    whole = yaml.safe_load(SCHEMA.read_text("utf-8"))
    for name, part in whole["$defs"].items():
        _tighten(part, is_value=name.startswith("edgevpr "))
    return whole


def _tighten(part: Any, is_value: bool = True) -> None:
    """A part that stands for a value is closed; one that others are made of is closed where it is used."""
    if "properties" in part:
        part["required"] = [name for name, each in part["properties"].items() if "only" not in each]
    if is_value and ("properties" in part or "$ref" in part):
        part["unevaluatedProperties"] = False
    inner = [part[key] for key in ("items", "additionalProperties") if isinstance(part.get(key), dict)]
    for each in [*part.get("properties", {}).values(), *part.get("anyOf", []), *inner]:
        _tighten(each)


def require_documented(command: str, printed: str) -> None:
    """Raise a ValidationError if the output of a command is not as its schema says."""
    from jsonschema import Draft202012Validator

    Draft202012Validator({"$ref": f"#/$defs/{command}", **read_schema()}).validate(json.loads(printed))


class Checked:
    """In place of the module `json`, for what prints results: checks what it prints."""

    @staticmethod
    def dumps(value: Any, **how: Any) -> str:
        frame = sys._getframe()
        while (args := frame.f_locals.get("args")) is None or not hasattr(args, "parser"):
            frame = frame.f_back
        printed = json.dumps(value, **how)
        require_documented(args.parser.prog, printed)
        return printed
