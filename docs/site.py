"""Adds to the site what is not a page of this folder: pages from elsewhere in the repository, and the references of the
configuration, the command line and the JSON output, generated from the code and the schema.

A link between two files of the repository becomes one between two pages of the site; a link to a file that is not a
page leads to the repository.
"""

import argparse
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from string import Formatter
from typing import Any

import yaml
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

from edgevpr.cli.main import EXIT_CODES, make_parser
from edgevpr.core.config import Config, Key, list_keys
from edgevpr.core.reasons import Code, ReasonCode
from edgevpr.mavlink.channel import Channel
from edgevpr.mavlink.channelselector import TABLES
from edgevpr.runtime.service.findingcodes import FindingCode

ROOT = Path(__file__).resolve().parents[1]
RESULTS = "benchmarks/results"
PAGES = {
    "ARCHITECTURE.md": "explanation/architecture.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "deploy/README.md": "how-to/install-the-service.md",
    "models/README.md": "reference/networks.md",
}
KINDS = {str: "text", float: "number", int: "whole number", bool: "true or false"}
CHANNELS = {
    Channel.COMMAND: "single fixes (command 43003)",
    Channel.GPS_INPUT: "GPS_INPUT, as a GPS receiver",
    Channel.ODOMETRY: "ODOMETRY",
    Channel.SENSOR: "message 296",
    Channel.VISION: "ODOMETRY",
}
PARAMETERS_INTRODUCTION = """\
These parameters determine the effect of edgevpr's positions. Generated from the table in `edgevpr/mavlink` that `run`
and `doctor` use. `doctor` lists each parameter with a wrong value, and the exact change.

A flight reads all of them at the start, and then again in turn: it notices a change at once if the autopilot broadcasts
it, otherwise within two minutes. Nothing is sent until they are answered, or while one is dangerous; the ground station
shows why. A value that only makes edgevpr useless or weak is reported once. Ignore a parameter that your firmware does
not have. "We" and "us" refer to edgevpr."""
LINK = re.compile(r"\]\((?!https?:|mailto:|#)([^)\s#]+)(#[^)\s]*)?\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are not in the folder of the documents."""
    for source, page in (PAGES | list_results()).items():
        files.append(File.generated(config, page, abs_src_path=str(ROOT / source)))
    files.append(File.generated(config, "results/index.md", content=render_results_index()))
    files.append(File.generated(config, "reference/configuration.md", content=render_configuration()))
    files.append(File.generated(config, "reference/parameters.md", content=render_parameters()))
    files.append(File.generated(config, "reference/command-line.md", content=render_commands()))
    files.append(File.generated(config, "reference/json-output.md", content=render_json_output()))
    files.append(File.generated(config, "reference/reasons.md", content=render_reasons()))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Turn links between files of the repository into links between pages of the site."""
    sources = {page: source for source, page in (PAGES | list_results()).items()}
    source = sources.get(page.file.src_uri, f"docs/{page.file.src_uri}")

    def replace_link(link: re.Match[str]) -> str:
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), link[1]))
        page_path = PAGES.get(target) or list_results().get(target)
        if target == RESULTS:
            page_path = "results/index.md"
        if target.startswith("docs/"):
            page_path = target.removeprefix("docs/")
        if page_path is None:
            if not (ROOT / target).exists():
                raise FileNotFoundError(f"{source}: {link[1]} does not exist")
            return f"]({config.repo_url}/blob/main/{target}{link[2] or ''})"
        return f"]({posixpath.relpath(page_path, posixpath.dirname(page.file.src_uri) or '.')}{link[2] or ''})"

    return LINK.sub(replace_link, markdown)


def list_results() -> dict[str, str]:
    """Return the page (or picture) of the site for every page and picture of the results."""
    kinds = (".md", ".png", ".jpg", ".webp")
    names = sorted(path.name for path in (ROOT / RESULTS).iterdir() if path.suffix in kinds)
    return {f"{RESULTS}/{name}": f"results/{name}" for name in names}


def render_results_index() -> str:
    """Return a page that lists the pages of results by their titles."""
    lines = ["# All results", "", "Each page names the command and the machine that produced it.", ""]
    for source, page in list_results().items():
        if source.endswith(".md"):
            title = re.search(r"^# (.+)$", (ROOT / source).read_text("utf-8"), re.M)
            lines.append(f"* [{title[1] if title else page}]({posixpath.basename(page)})")
    return "\n".join(lines) + "\n"


def render_configuration() -> str:
    """Return the page of the configuration, with the text of `deploy/config.yaml` and the types of the code."""
    lines = ["# Configuration", "", "Generated from `deploy/config.yaml` and `edgevpr/core/config.py`."]
    text, comment, section = (ROOT / "deploy/config.yaml").read_text("utf-8"), [], ""
    keys = {key.name: key for key in list_keys(Config)}
    for line in text.splitlines():
        if match := re.match(r"( *)# ?(.*)", line):
            comment.append(match[2])
            continue
        if match := re.match(r"( *)(\w+): *(.*)", line):
            name = f"{section}.{match[2]}" if match[1] else match[2]
            if not match[3]:
                section = match[2]
                lines += ["", f"## {section}", "", *comment]
            else:
                facts = [describe_key(key, match[3]) for key in keys.values() if f"{key.name}.".startswith(f"{name}.")]
                lines += ["", f"### `{name}`", "", *facts, "", *comment]
        elif comment and not line.strip():
            lines += ["", *comment]
        comment = []
    return "\n".join(lines) + "\n"


def describe_key(key: Key, default: str) -> str:
    """Return type, default, limits and flag of a key."""
    facts = [KINDS[key.kind], f"default `{default}`"]
    if key.limits:
        facts.append(f"{key.limits[0]:g} to {key.limits[1]:g}")
    if key.flags:
        facts.append(f"flag {', '.join(f'`{name}`' for name in key.flags)}")
    return f"*{'; '.join(facts)}*"


def render_parameters() -> str:
    """Return the page of the autopilot's parameters, made from the table that `run` and `doctor` use."""
    lines = ["# Parameters of the autopilot", "", PARAMETERS_INTRODUCTION]
    for table in TABLES.values():
        lines += ["", f"## {table.name}"]
        for channel in dict.fromkeys(channel for rule in table.rules for channel in rule.channels):
            lines += ["", f"### {table.name} by {CHANNELS[channel]}", ""]
            lines += ["| parameter | correct value | otherwise | why |", "|---|---|---|---|"]
            for rule in (rule for rule in table.rules if channel in rule.channels):
                otherwise = "**nothing is sent**" if rule.is_dangerous else "reported"
                lines.append(f"| `{rule.label}` | {rule.right} | {otherwise} | {rule.why} |")
    return "\n".join(lines) + "\n"


def render_commands() -> str:
    """Return the page of the command line: every command with its usage and its flags."""
    lines = ["# Command line", "", "Generated from the program's help. `--debug` shows the traceback of an error.", ""]
    lines += ["## Exit codes", "", "| code | meaning |", "|---|---|"]
    lines += [*(f"| {code} | {meaning} |" for code, meaning in EXIT_CODES.items()), ""]
    for parser in list_parsers(make_parser()):
        lines += [f"## {parser.prog}", "", parser.description or "", ""]
        lines += ["```text", re.sub(r"^usage: ", "", parser.format_usage()).rstrip(), "```", ""]
        actions = [action for action in parser._actions if action.help not in (None, argparse.SUPPRESS)]
        rows = [(format_argument(action), action.help) for action in actions]
        rows = [(name, text) for name, text in rows if name and not name.startswith("`-h`")]
        if rows:
            lines += ["| argument | meaning |", "|---|---|"]
            lines += [f"| {name} | {str(text).replace('|', '&#124;')} |" for name, text in rows]
            lines.append("")
    return "\n".join(lines)


def render_json_output() -> str:
    """Return the page of the output of `--json`, made from its schema."""
    path = "docs/reference/json-output.yaml"
    schema = yaml.safe_load((ROOT / path).read_text("utf-8"))
    lines = ["# JSON output", "", "\n".join(re.findall(r"^# ?(.*)", (ROOT / path).read_text("utf-8"), re.M)), ""]
    lines += [
        "With `--json` a command prints its result on stdout and nothing else; messages go to stderr. A field keeps",
        "its name and meaning from version to version; new fields may be added, so ignore those that you do not know.",
        f"The tests check every output against [the schema]({path}).",
    ]
    for name, part in schema["$defs"].items():
        lines += ["", f"## {name}", "", part.get("description", ""), "", "| field | type | meaning |", "|---|---|---|"]
        lines += [f"| {field} | {kind} | {text} |" for field, kind, text in list_fields(part, "")]
    return "\n".join(lines) + "\n"


def render_reasons() -> str:
    """Return the page of the reasons and findings, made from their tables."""
    lines = ["# Reasons", ""]
    lines += [
        "Why a match is accepted or refused, why a fix is not sent or not accepted, and what `check` and `doctor` find."
    ]
    lines += [
        "Flight log and `--json` contain the code and its parameters (here in braces); sentences may change. Made from"
    ]
    lines += ["`edgevpr/core/reasons.py` and `edgevpr/runtime/service/findingcodes.py`.", ""]
    lines += ["| code | in short | sentence |", "|---|---|---|"]
    lines += [f"| `{code.name}` | {code.summary} | {format_sentence(code)} |" for code in ReasonCode]
    lines += ["", "## Findings of `check` and `doctor`", "", "Some findings have a code of the table above.", ""]
    lines += ["| code | sentence |", "|---|---|"]
    lines += [f"| `{code.name}` | {format_sentence(code)} |" for code in FindingCode]
    return "\n".join(lines) + "\n"


def format_sentence(code: Code) -> str:
    """Return the sentence of a code, with the names of its parameters in braces."""
    pieces = [piece for part in code.parts for piece in Formatter().parse(part)]
    sentence = "".join(f"{text}{{{name}}}" if name else text for text, name, _, _ in pieces)
    return sentence.replace("{summary}", code.summary)


def list_fields(part: dict[str, Any], prefix: str) -> Iterator[tuple[str, str, str]]:
    """Yield field, type and meaning of all fields in a part of the schema, including those of inner objects."""
    if "$ref" in part:
        name = part["$ref"].rpartition("/")[2]
        yield f"`{prefix}*`", "", f"the fields of [{name}](#{name})"
    for name, field in part.get("properties", {}).items():
        kinds = field.get("type", "")
        kind = " or ".join([kinds] if isinstance(kinds, str) else kinds)
        only = f"only with {field['only']}" if str(field.get("only", "")).startswith("--") else field.get("only", "")
        only = f"only if {only}" if only and not only.startswith("only") else only
        texts = [field.get("description", ""), only, ", ".join(f"`{value}`" for value in field.get("enum", ()))]
        yield f"`{prefix}{name}`", kind, "; ".join(filter(None, texts))
        yield from list_fields({key: field[key] for key in field.keys() - {"description"}}, f"{prefix}{name}.")
    if isinstance(part.get("items"), dict):
        yield from list_fields(part["items"], f"{prefix}[].")
    for field in part.get("anyOf", ()):
        yield from list_fields(field, prefix)


def list_parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """Yield the parsers of all commands that can be run, depth first."""
    groups = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if not groups:
        yield parser
    for group in groups:
        for command in group.choices.values():
            yield from list_parsers(command)


def format_argument(action: argparse.Action) -> str:
    """Return the notation of an argument: its flags and its placeholder."""
    if isinstance(action, argparse._SubParsersAction):
        return ""
    placeholder = action.metavar or (action.choices and "{" + ",".join(map(str, action.choices)) + "}")
    value = "" if action.nargs == 0 else f" {placeholder or action.dest.upper()}"
    if not action.option_strings:
        return f"`{placeholder or action.dest}`"
    return ", ".join(f"`{flag}{value}`" for flag in action.option_strings)
