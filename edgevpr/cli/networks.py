"""`edgevpr models`: list and add networks."""

from argparse import Namespace
from dataclasses import asdict
from pathlib import Path
from typing import Any

from edgevpr.cli.shared import add_json, command, group, lines_of, show


def add(commands: Any) -> None:
    """Add the commands and their flags."""
    models = group(commands, "models", "list and add neural networks")
    add_json(command(models, "list", models_list, "list the networks, their origin and what uses them"))
    adding = command(models, "add", models_add, "run a network, and copy it and its card to your models folder")
    adding.add_argument("file", metavar="FILE.onnx")
    adding.add_argument(
        "--card", required=True, metavar="CARD.yaml", help="card of the network (YAML); its name is that of the network"
    )
    add_json(adding)


def models_list(args: Namespace) -> int:
    """Run `models list`: print every network's card, also of those that cannot be used."""
    from edgevpr.core.files import model_folders
    from edgevpr.runtime.preflight.networks import list_models

    found = [asdict(each) for each in list_models()]
    text = {each["name"]: {name: value for name, value in each.items() if name != "name"} for each in found}
    show(found, args.json, lines_of({**text, "folders": list(map(str, model_folders()))}))
    return 0


def models_add(args: Namespace) -> int:
    """Run `models add`: try a network, and copy it with its card to the user's models folder."""
    from edgevpr.runtime.preflight.networks import add

    show(asdict(add(Path(args.file), Path(args.card))), args.json)
    return 0
