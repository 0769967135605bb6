"""`edgevpr models`: list, try and add networks."""

from argparse import Namespace
from dataclasses import asdict
from pathlib import Path
from typing import Any

from edgevpr.cli.shared import add_json, command, group, lines_of, show
from edgevpr.core.errors import EdgevprError, ModelError
from edgevpr.core.text import progress


def add(commands: Any) -> None:
    """Add the commands and their flags."""
    models = group(commands, "models", "list, verify and add neural networks")
    add_json(command(models, "list", models_list, "list the networks, their origin and what uses them"))
    verify = command(models, "verify", models_verify, "run networks on this computer, and measure them")
    verify.add_argument("name", metavar="NAME", nargs="?", help="network to verify (default: all)")
    add_json(verify)
    adding = command(models, "add", models_add, "verify a network, and copy it and its card to your models folder")
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


def models_verify(args: Namespace) -> int:
    """Run `models verify`: run one network or all, and print what each takes in time and memory."""
    from edgevpr.power.boards import load_board
    from edgevpr.runtime.preflight.networks import verify
    from edgevpr.techniques.card import card_names, load_card

    threads = load_board("this").threads
    names = [args.name] if args.name else card_names()
    if not names:
        raise ModelError("There is no network yet: add one with `edgevpr models add FILE.onnx --card CARD.yaml`.")
    works, wrong = [], {}
    for name in progress(names, len(names), "trying networks"):
        try:
            works.append(asdict(verify(load_card(name), threads)))
        except EdgevprError as error:
            wrong[name] = str(error)
    show({"works": works, "wrong": wrong}, args.json)
    return 1 if wrong else 0


def models_add(args: Namespace) -> int:
    """Run `models add`: try a network, and copy it with its card to the user's models folder."""
    from edgevpr.power.boards import load_board
    from edgevpr.runtime.preflight.networks import add

    verified, card = add(Path(args.file), Path(args.card), load_board("this").threads)
    show({"card": str(card), **asdict(verified)}, args.json)
    return 0
