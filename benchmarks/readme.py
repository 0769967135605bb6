"""Put the figures of benchmarks/results/ into the README, between its two markers: no figure there is typed by hand."""

import json
from pathlib import Path

from edgevpr.evaluate.tables import markdown

REPOSITORY = Path(__file__).resolve().parents[1]
RESULTS = REPOSITORY / "benchmarks" / "results"
BEGIN, END = "<!-- figures: made by benchmarks/readme.py -->\n", "<!-- end of figures -->"
FORMS = ("hog", "cohog_thesis", "cohog_exact", "cohog")


def main() -> None:
    page = REPOSITORY / "README.md"
    before, _, rest = page.read_text(encoding="utf-8").partition(BEGIN)
    _, _, after = rest.partition(END)
    page.write_text(f"{before}{BEGIN}\n{recall()}\n\n{speed()}\n\n{END}{after}", encoding="utf-8")


def recall() -> str:
    """Recall@1 of every form on every set, and what the rule of the flight would have let through."""
    rows = []
    for path in sorted(RESULTS.glob("*.json")):
        content = json.loads(path.read_text())
        if "techniques" not in content:
            continue
        found = content["techniques"]
        shares = [f"{found[form]['recall_at_1']:.2f}" if form in found else "-" for form in FORMS]
        name = "cohog" if "cohog" in found else "hog"
        flown = found[name]
        accepted = f"`{name}`: {flown['accepted']} of {flown['queries']}, {flown['accepted_wrong']} wrong"
        rows.append([f"{content['set']} ({content['use']})", *shares, accepted])
    heads = ("set", "`hog`", "`cohog`, thesis", "`cohog`, exact vote", "**`cohog`, as flown**", "accepted in flight")
    return f"Recall@1, made by `make results`:\n\n{markdown(heads, rows)}"


def speed() -> str:
    """The figures of `make bench` that a builder asks for."""
    content = json.loads((RESULTS / "bench.json").read_text())
    machine = content["machine"]
    rows = [
        [f"encode a frame ({row['entropy']})", f"{row['ours_ms']:.1f} ms", f"{row['ratio']:.1f}x the published way"]
        for row in content["encode"]
    ]
    (match,) = content["match"]
    rows.append(["compare one place in full", f"{match['ours_ms']:.2f} ms", f"{match['ratio']:.1f}x the published way"])
    for row in content["two_stage"]:
        ratio = f"{row['ratio']:.0f}x the vote over all" if row["ratio"] else "24 rotations"
        rows.append([f"query, 10 000 places, {row['camera']}", f"{row['two_stage_ms']:.0f} ms", ratio])
    rows.append(["RAM of a place", f"{content['two_stage'][0]['bytes_per_place']} bytes", "the thesis's: 123 008"])
    rows += [[row["what"], f"{row['value']:.3g} {row['unit']}", "10 000 places"] for row in content["flight"]]
    return (
        f"Speed and memory on one thread of an {machine['cpu']}, made by `make bench`:\n\n"
        f"{markdown(('what', 'measured', 'beside'), rows)}"
    )


if __name__ == "__main__":
    main()
