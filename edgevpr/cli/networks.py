"""`edgevpr models`: list and try networks."""

from argparse import Namespace
from dataclasses import asdict
from typing import Any

from edgevpr.cli.shared import add_json, command, format_fields, group, show


def add(commands: Any) -> None:
    """Add the commands and their flags."""
    models = group(commands, "models", "list and try neural networks")
    add_json(command(models, "list", models_list, "run each network once, and list their origin and what uses them"))


def models_list(args: Namespace) -> int:
    """Run `models list`: print every network's card, also of those that cannot be used."""
    from edgevpr.core.files import model_folders
    from edgevpr.runtime.preflight.networks import list_models

    found = [asdict(each) for each in list_models()]
    text = {each["name"]: {name: value for name, value in each.items() if name != "name"} for each in found}
    show(found, args.json, format_fields({**text, "folders": list(map(str, model_folders()))}))
    return 0
