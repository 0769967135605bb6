"""Streams that break, pictures that say nothing, and maps that are damaged, all made from a seed: `make hostile` writes
benchmarks/results/hostile.md and hostile.json.

python benchmarks/hostile.py [--parts A,B] [--seed N]

The tables say what was tried, how often, and what came of it.
"""

import argparse
from dataclasses import asdict, is_dataclass

import base
import damaged_streams
import hostile_maps
import hostile_pictures
from base import Row

# name: (title, how it is run, usual count: of pictures of each stream, pictures of each kind in each map, maps)
PARTS = {
    "streams": ("Streams: pictures that are cut, corrupted, lost or frozen", damaged_streams.run, 240),
    "pictures": ("Pictures that say nothing, of other ground, and behind a display", hostile_pictures.run, 100),
    "maps": ("Maps that are damaged", hostile_maps.run, 200),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", metavar="A,B", default=",".join(PARTS), help=f"some of {', '.join(PARTS)}")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    for name in args.parts.split(","):
        _, run, count = PARTS[name]
        print(f"trying: {name}", flush=True)
        rows = [asdict(row) if is_dataclass(row) else row for row in run(count, args.seed)]
        result = base.read("hostile") | {name: {**base.describe_run(), "seed": args.seed, "rows": rows}}
        base.write("hostile", result, format_page(result))


def format_page(result: Row) -> str:
    """Return the page for people: a table for each part, with the fields of its rows as columns."""
    parts = ["# Tried as a hostile world would\n\nMade by `make hostile`: all inputs come from a seed."]
    for name, (title, _, _) in PARTS.items():
        if part := result.get(name):
            origin = f"{part['date']}, commit {part['commit']}, seed {part['seed']}, {part['machine']['cpu']}."
            rows = [{key: _format_value(value) for key, value in row.items()} for row in part["rows"]]
            columns = {key.replace("_", " "): f"{{{key}}}" for key in rows[0]}
            parts.append(f"## {title}\n\n{origin}\n\n{base.format_table(rows, columns)}")
    return "\n\n".join(parts)


def _format_value(value: object) -> str:
    """Return a figure in three digits, and of counts by reason those that are not 0."""
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, dict):
        return ", ".join(f"{count} {reason}" for reason, count in value.items() if count) or "0"
    return str(value)


if __name__ == "__main__":
    base.run(main, opencv_threads=None)
