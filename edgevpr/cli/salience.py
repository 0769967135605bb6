"""`edgevpr salience`: what of a picture is worth remembering, as numbers and as a picture."""

from argparse import Namespace
from dataclasses import asdict
from pathlib import Path
from typing import Any

from edgevpr.cli.shared import add_json, command, config_of, print_json
from edgevpr.core.errors import UsageError


def add(commands: Any) -> None:
    """Add the command and its flags."""
    parser = command(commands, "salience", salience, "say what of a picture is worth remembering")
    parser.add_argument("image", metavar="IMAGE")
    parser.add_argument("--out", metavar="PNG", help="draw the picture with its three maps")
    parser.add_argument("--config", metavar="FILE", help="YAML; its section `salience` counts")
    parser.add_argument("--network", metavar="NAME", help="the card of the network of memorability")
    parser.add_argument("--detector", metavar="NAME", help="the card of the object detector")
    add_json(parser)


def salience(args: Namespace) -> int:
    """Print the scores of a picture, and draw its maps."""
    from edgevpr.core.files import require_folder, write_whole
    from edgevpr.frames.images import read_image
    from edgevpr.runtime.recognise.opening import gate_of
    from edgevpr.runtime.recognise.salience_gate import worth_of
    from edgevpr.runtime.recognise.salience_maps import in_words, panels, png, scores_of

    asked = {"salience.use": True, "salience.network": args.network, "salience.detector": args.detector}
    gate = gate_of(config_of(args, args.config, **asked).salience)
    out = Path(args.out) if args.out else None
    if out:
        if out.suffix.lower() != ".png":
            raise UsageError(f"--out {out}: give a name that ends in .png.")
        require_folder(out)
    image = read_image(Path(args.image))
    maps = gate.maps(image)
    worth = worth_of(scores_of(maps), gate.thresholds)
    if args.json:
        print_json(
            {"image": args.image, **asdict(worth.salience), "kept": worth.reason is None, "reason": worth.reason}
        )
    else:
        for name, score in worth.salience.scores.items():
            print(f"{name:<13} {in_words(score)}")
        print(worth.reason or "worth remembering")
    if out:
        drawn = png(panels(image, maps, worth.salience))
        write_whole(out, lambda unfinished: unfinished.write_bytes(drawn))
    return 0
