"""Try broken streams, pictures that show no place, and damaged maps, all made from a seed: `make hostile` writes
benchmarks/results/hostile.md and hostile.json.

python benchmarks/hostile.py [--parts A,B] [--seed N]
"""

import argparse
from dataclasses import asdict, is_dataclass

import base
import damaged_streams
import hostile_maps
import hostile_pictures
from base import Row

# name: (title, function, count: pictures of each stream, pictures of each kind in each map, or maps)
PARTS = {
    "streams": ("Streams: pictures that are cut, corrupted, lost or frozen", damaged_streams.run, 240),
    "pictures": ("Pictures of nothing, of other ground, and behind a display", hostile_pictures.run, 100),
    "maps": ("Maps that are damaged", hostile_maps.run, 200),
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", metavar="A,B", default=",".join(PARTS), help="parts to try (default: all)")
    parser.add_argument("--seed", type=int, default=1)
    args = parser.parse_args()
    for name in args.parts.split(","):
        _, run, count = PARTS[name]
        print(f"trying {name}", flush=True)
        rows = [asdict(row) if is_dataclass(row) else row for row in run(count, args.seed)]
        result = base.read("hostile") | {name: {**base.describe_run(), "seed": args.seed, "rows": rows}}
        base.write("hostile", result, format_page(result))


def format_page(result: Row) -> str:
    """Return the results as Markdown: a table for each part, with the fields of its rows as columns."""
    parts = ["# Hostile streams, pictures and maps\n\nMade by `make hostile`: all inputs come from a seed."]
    for name, (title, _, _) in PARTS.items():
        if part := result.get(name):
            origin = f"{part['date']}, commit {part['commit']}, seed {part['seed']}, {part['machine']['cpu']}."
            rows = [{key: _format_value(value) for key, value in row.items()} for row in part["rows"]]
            columns = {key.replace("_", " "): f"{{{key}}}" for key in rows[0]}
            parts.append(f"## {title}\n\n{origin}\n\n{base.format_table(rows, columns)}")
    return "\n\n".join(parts)


def _format_value(value: object) -> str:
    """Format a float with three digits, and counts by reason without zeros."""
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, dict):
        return ", ".join(f"{count} {reason}" for reason, count in value.items() if count) or "0"
    return str(value)


if __name__ == "__main__":
    base.run(main, opencv_threads=None)
