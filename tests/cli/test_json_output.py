"""`--json`: every command that has it is in the schema. `conftest.documented` holds what they print to it."""

import argparse
import json

import jsonschema
import pytest
from documented import require_documented, schema

from edgevpr.cli.main import make_parser


def commands_with_json(parser=None):
    parser = parser or make_parser()
    if "--json" in parser._option_string_actions:
        yield parser.prog
    for each in parser._actions:
        if isinstance(each, argparse._SubParsersAction):
            for inner in each.choices.values():
                yield from commands_with_json(inner)


def test_schema_defines_every_command_and_no_other():
    jsonschema.Draft202012Validator.check_schema(schema())
    assert {name for name in schema()["$defs"] if name.startswith("edgevpr ")} == set(commands_with_json())


def test_require_documented_refuses_other_fields():
    whole = {"path": "m.gpkg", "kept": 3, "dropped": 0, "original": None}
    require_documented("edgevpr map repair", json.dumps(whole))
    for other in (whole | {"kept": "3"}, whole | {"more": 1}, {"path": "m.gpkg", "kept": 3}):
        with pytest.raises(jsonschema.ValidationError):
            require_documented("edgevpr map repair", json.dumps(other))
