"""`edgevpr salience`: what of a picture is worth remembering."""

from argparse import Namespace
from dataclasses import asdict
from pathlib import Path
from typing import Any

from edgevpr.cli.shared import add_json, command, config_of, print_json


def add(commands: Any) -> None:
    """Add the command and its flags."""
    parser = command(commands, "salience", salience, "say what of a picture is worth remembering")
    parser.add_argument("image", metavar="IMAGE")
    parser.add_argument("--config", metavar="FILE", help="YAML; its section `salience` counts")
    parser.add_argument("--network", metavar="NAME", help="the card of the network of memorability")
    parser.add_argument("--detector", metavar="NAME", help="the card of the object detector")
    add_json(parser)


def salience(args: Namespace) -> int:
    """Print the scores of a picture."""
    from edgevpr.frames.images import read_image
    from edgevpr.runtime.recognise.opening import gate_with
    from edgevpr.runtime.recognise.salience_gate import scores_of, worth_of

    asked = {"salience.use": True, "salience.network": args.network, "salience.detector": args.detector}
    gate = gate_with(config_of(args, args.config, **asked).salience)
    maps = gate.maps(read_image(Path(args.image)))
    worth = worth_of(scores_of(maps), gate.thresholds)
    if args.json:
        print_json(
            {"image": args.image, **asdict(worth.salience), "kept": worth.reason is None, "reason": worth.reason}
        )
    else:
        for name, score in worth.salience.scores.items():
            print(f"{name:<13} {'off' if score is None else f'{score:.2f}'}")
        print(worth.reason or "worth remembering")
    return 0
