"""`edgevpr models`: list and try networks."""

from argparse import Namespace
from dataclasses import asdict
from typing import Any

from edgevpr.cli.shared import add_command, add_group, add_json, format_fields, print_result


def add(commands: Any) -> None:
    """Add the commands and their flags."""
    models = add_group(commands, "models", "list and try neural networks")
    add_json(add_command(models, "list", run_models_list, "run each network once, and list its origin and its uses"))


def run_models_list(args: Namespace) -> int:
    """Run `models list`: print every network's card, also of those that cannot be used."""
    from edgevpr.core.files import list_model_folders
    from edgevpr.runtime.preflight.networks import list_models

    models = [asdict(model) for model in list_models()]
    text = {model["name"]: {name: value for name, value in model.items() if name != "name"} for model in models}
    print_result(models, args.json, format_fields({**text, "folders": list(map(str, list_model_folders()))}))
    return 0
