"""`edgevpr models`: list and try networks."""

from argparse import Namespace
from dataclasses import asdict
from typing import Any

from edgevpr.cli.shared import add_command, add_group, add_json, format_fields, print_result


def add(commands: Any) -> None:
    """Add the commands and their flags."""
    models = add_group(commands, "models", "list and try neural networks")
    add_json(
        add_command(models, "list", run_models_list, "run each network once, and list their origin and what uses them")
    )


def run_models_list(args: Namespace) -> int:
    """Run `models list`: print every network's card, also of those that cannot be used."""
    from edgevpr.core.files import list_model_folders
    from edgevpr.runtime.preflight.networks import list_models

    found = [asdict(each) for each in list_models()]
    text = {each["name"]: {name: value for name, value in each.items() if name != "name"} for each in found}
    print_result(found, args.json, format_fields({**text, "folders": list(map(str, list_model_folders()))}))
    return 0
