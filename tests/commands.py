"""The commands, run in this process."""

import argparse
import json

from edgevpr.cli.main import main


def run(*argv) -> int:
    """Run a command, whose words need not be text."""
    return main([str(word) for word in argv])


def run_json(capsys, *argv):
    """Return what a command prints for programs."""
    capsys.readouterr()
    assert run(*argv, "--json") == 0
    return json.loads(capsys.readouterr().out)


def expect_refusal(capsys, *argv, code=2, is_alone=False) -> str:
    """Return the one sentence with which a command fails. `is_alone`: nothing else is shown, not even progress."""
    capsys.readouterr()
    assert run(*argv) == code
    said = capsys.readouterr().err
    sentence = said.splitlines()[-1]
    assert sentence.startswith("edgevpr: ")
    assert said.count(sentence) == 1
    assert not is_alone or said == f"{sentence}\n"
    assert "Traceback" not in said
    return sentence


def list_commands(parser):
    """The names of all commands, and their parsers."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for each in action.choices.values():
                yield from list_commands(each)
            return
    yield parser.prog.partition(" ")[2], parser
