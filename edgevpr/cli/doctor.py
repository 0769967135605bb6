"""`edgevpr doctor`: is the flight controller, and this board, set up for edgevpr?"""

from argparse import Namespace
from typing import Any

from edgevpr.cli.shared import add_json, add_keys, command, config_of, print_json
from edgevpr.core.errors import UsageError
from edgevpr.core.text import shown


def add(commands: Any) -> None:
    """Add the command and its flags."""
    parser = command(
        commands, "doctor", run_doctor, "ask the flight controller, and this board, what to change; nothing is written"
    )
    parser.add_argument("--config", metavar="FILE", help="that of the flight; flags given here override it")
    add_keys(parser, "mavlink.link")
    add_json(parser)


def run_doctor(args: Namespace) -> int:
    """Say what is fine, what is wrong, and what to change."""
    from dataclasses import asdict

    from edgevpr.core.text import waiting
    from edgevpr.mavlink.address import parse_link
    from edgevpr.runtime.service.doctor import doctor
    from edgevpr.runtime.service.finding import lines

    config = config_of(args, args.config)
    if config.mavlink.link is None:
        raise UsageError("There is no link to the flight controller: name one with --link, or in --config.")
    address = parse_link(config.mavlink.link)
    diagnosis = doctor(config, address, waiting)
    if args.json:
        print_json({"link": str(address), "ok": diagnosis.is_fine, **asdict(diagnosis)})
    else:
        for line in lines(diagnosis.findings):
            print(shown(line))
    return 0 if diagnosis.is_fine else 1
