"""The commands in README, tutorials and how-to pages: each can be typed as it stands."""

import re
import shlex
from pathlib import Path

import pytest
from simulated import autopilot

from edgevpr.cli.main import make_parser

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "deploy/README.md", *sorted((ROOT / "docs").rglob("*.md"))]
SIMULATED_AUTOPILOT = f"python {Path(autopilot.__file__).relative_to(ROOT)} "
BLOCK = re.compile(r"^```(?:sh|text|console)?\n(.*?)^```", re.M | re.S)


def read_commands(page: Path) -> list[str]:
    """Return the commands of edgevpr and of the simulated autopilot in a page, without prompts and comments."""
    commands = []
    for block in BLOCK.findall(page.read_text("utf-8")):
        lines = block.replace("\\\n", " ").splitlines()
        is_session = any(line.startswith("$ ") for line in lines)
        for line in lines:
            if is_session and not line.startswith("$ "):
                continue
            for command in re.split(r"&&|;|\|", line.removeprefix("$ ").partition("  #")[0]):
                words = command.strip()
                if words.startswith(("edgevpr ", SIMULATED_AUTOPILOT)) and "..." not in words:
                    commands.append(words)
    return commands


def is_valid(command: str) -> bool:
    """Return whether the command line takes a command; a wrong one is explained on stderr."""
    is_simulated = command.startswith(SIMULATED_AUTOPILOT)
    parser = autopilot.make_parser() if is_simulated else make_parser()
    try:
        parser.parse_args(shlex.split(command, comments=True)[2 if is_simulated else 1 :])
    except SystemExit as ended:
        return ended.code == 0
    return True


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_of_a_page_can_be_typed(page):
    assert [command for command in read_commands(page) if not is_valid(command)] == []


def test_architecture_names_files_and_functions_that_exist():
    text = " ".join((ROOT / "ARCHITECTURE.md").read_text("utf-8").split())
    paths = re.findall(r"`((?:[a-z_]+/)+(?:[a-z_]+\.[a-z]+)?)`", text)
    assert len(paths) > 80
    assert [path for path in paths if not ((ROOT / "edgevpr" / path).exists() or (ROOT / path).exists())] == []
    named = re.findall(r"`(?:[A-Za-z]+\.)?(\w+)` (?:\(|in )`([a-z_/]+\.py)`", text)
    assert len(named) > 35
    assert [
        (name, path)
        for name, path in named
        if not re.search(rf"(?:def|class) {name}\b", (ROOT / "edgevpr" / path).read_text("utf-8"))
    ] == []
