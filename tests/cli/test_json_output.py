"""`--json`: every command that has it is in the schema. `conftest.documented` holds what they print to it."""

import json

import jsonschema
import pytest
from commands import list_commands
from documented import read_schema, require_documented

from edgevpr.cli.main import make_parser


def test_schema_defines_every_command_and_no_other():
    jsonschema.Draft202012Validator.check_schema(read_schema())
    commands = {parser.prog for _, parser in list_commands(make_parser()) if "--json" in parser._option_string_actions}
    assert {name for name in read_schema()["$defs"] if name.startswith("edgevpr ")} == commands


def test_require_documented_refuses_other_fields():
    whole = {"path": "m.gpkg", "kept": 3, "dropped": 0, "original": None}
    require_documented("edgevpr map repair", json.dumps(whole))
    for other in (whole | {"kept": "3"}, whole | {"more": 1}, {"path": "m.gpkg", "kept": 3}):
        with pytest.raises(jsonschema.ValidationError):
            require_documented("edgevpr map repair", json.dumps(other))
