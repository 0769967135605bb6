"""The page of `peers.py`: benchmarks/results/peers.md."""

import textwrap
from statistics import median
from typing import Any

import onnxruntime
from run_sets import TUNED_ON

from edgevpr.core.tables import markdown
from peers.ways import WAYS

OURS = "cohog (edgevpr)"
_COSTS = "t_e ms", "t_m ms", "B/place", "RAM MB", "import s"


def write(found: dict[str, Any]) -> str:
    """Return the page of all that was found."""
    machine = found["machine"]
    commits = sorted({row["commit"] for kind in ("rows", "networks") for row in found[kind].values()})
    sets = sorted({key.partition(": ")[0] for key in found["rows"]})
    sections = "\n".join(_of_set(name, found["rows"]) for name in sets)
    made = (
        f"Made by `make peers`, {found['date']}, commits {', '.join(commits)}, {machine['cores']} cores of "
        f"{machine['cpu']}, OpenCV {machine['opencv']}, onnxruntime {onnxruntime.__version__}."
    )
    costs = (
        "Times are those of the processor, on one thread, medians over the queries: `t_e` encodes a query, `t_m` "
        "matches it with all references. The machine was busy: of two runs, on five of the sets, all answers were the "
        "same, and the times of a row differed by less than a fifth as a rule, by a half at most. `B/place` is what "
        "the index takes in memory: for the published CoHOG and for the ratio tests that is the whole descriptor of "
        f"every reference. {_kept(found['rows'])} `RAM` is the peak of the process above the bare interpreter, with "
        "the references in it; maps and words were made before, by another process. `import` are the seconds of the "
        "processor until the libraries are loaded. Words (bag of words, pydbow, VLAD) are learnt on the references of "
        f"{', '.join(TUNED_ON[:-1])} and {TUNED_ON[-1]}. The 95 % are of recall@1: what other queries of the same kind "
        "would give. Of a set at most 200 queries are asked, evenly spaced."
    )
    return f"""# Beside other ways

{_filled(made)}

Recall@1 on the sets that `cohog` was not tuned on ([sets.md](sets.md) names what they had a say in all the same); in
brackets the queries. Looking down `cohog` is told so, and knows neither heading nor height. Every way has the same
queries and the same references, in the sizes of the set.

{_recalls(sets, found["rows"])}

{_READING}
## Costs

{_filled(costs)}

{sections}
{_networks(found)}
{_LEFT_OUT}"""


def _filled(text: str) -> str:
    return textwrap.fill(text, 120, break_long_words=False, break_on_hyphens=False)


def _recalls(sets: list[str], rows: dict[str, Any]) -> str:
    lines = []
    for way in (OURS, *WAYS):
        cells = [rows.get(f"{name}: {way}") for name in sets]
        lines.append((way, *(f"{row['quality']['recall_at_1']:.2f}" if row else "-" for row in cells)))
    queries = [next(row for key, row in rows.items() if key.startswith(f"{name}: "))["quality"] for name in sets]
    return markdown(("way", *(f"{n} ({q['queries']})" for n, q in zip(sets, queries, strict=True))), lines)


def _kept(rows: dict[str, Any]) -> str:
    sizes = [row["file_bytes"] / 1e3 for row in rows.values() if "file_bytes" in row]
    return (
        f"`cohog` has besides {min(sizes):.0f} to {max(sizes):.0f} KB a place in its map file, of which a match reads "
        "the places that it compares."
    )


def _of_set(name: str, rows: dict[str, Any]) -> str:
    of_set = {way: rows[key] for way in (OURS, *WAYS) if (key := f"{name}: {way}") in rows}
    lines = [
        (
            way,
            f"{row['quality']['recall_at_1']:.3f}",
            "{:.2f}-{:.2f}".format(*row["quality"]["recall_at_1_interval"]),
            f"{row['quality']['recall_at_5']:.3f}",
            f"{row['quality']['precision_at_100_recall']:.3f}",
            f"{row['quality']['recall_at_100_precision']:.3f}",
            f"{row['quality']['auc']:.3f}",
            *_costs(row),
        )
        for way, row in of_set.items()
    ]
    titles = "way", "recall@1", "95 %", "@5", "P@100%R", "R@100%P", "AUC", *_COSTS
    first = next(iter(of_set.values()))["quality"]
    return f"### {name}\n\n{first['queries']} queries, {first['references']} references.\n\n{markdown(titles, lines)}\n"


def _costs(row: dict[str, Any]) -> tuple[str, ...]:
    return (
        f"{row['t_encode_ms']:.1f}",
        f"{row['t_match_ms']:.1f}",
        f"{row['bytes']:,.0f}",
        f"{row['ram_mb']:.0f}",
        f"{row['import_s']:.2f}",
    )


def _networks(found: dict[str, Any]) -> str:
    lines = [
        (
            name,
            f"{row['length']:,}",
            f"{row['parameters_m']:.1f}" if "parameters_m" in row else "-",
            f"{row['gmacs']:.1f}" if "gmacs" in row else "-",
            f"{row['file_mb']:.0f}",
            f"{row['t_encode_ms']:,.0f}",
            f"{row['t_match_ms']:.1f}",
            f"{row['bytes']:,}",
            f"{row['bytes_1bit']:,}",
            f"{row['ram_mb']:.0f}",
            f"{row['import_s'] + row['open_s']:.2f}",
        )
        for name, row in found["networks"].items()
    ]
    titles = "network", "numbers", "10^6 parameters", "10^9 MAC", "file MB", "t_e ms", "t_m ms", "B/place", "1bit"
    ours_ms = median(row["t_encode_ms"] for key, row in found["rows"].items() if key.endswith(OURS))
    times = [round(row["t_encode_ms"] / ours_ms) for name, row in found["networks"].items() if name != "calc"]
    text = (
        "By the recipes of [modern networks](../../docs/how-to/modern-networks.md), run by edgevpr as techniques, one "
        "thread. **Their weights are random**: the weights of the authors could not be had here, so nothing is said of "
        "what they "
        "recognise. What they cost does not depend on what they have learnt. `t_m` is the scan of 1,000 places; "
        "`B/place` in half precision, and in the form of one bit a number; `cosplace_int8` is by `edgevpr models "
        "quantise`. `calc`, which edgevpr ships, stands beside. Against the "
        f"{ours_ms:.1f} ms of `cohog` encoding takes them {min(times)} to {max(times)} times as long; matching takes "
        "them less. Where a query may cost a second or there is more than a processor, and the camera looks along "
        "streets, as in their training, they are worth a try; a recipe takes minutes. Looking down at any heading is "
        "not what they were trained for."
    )
    return f"""## Modern networks

{_filled(text)}

{markdown((*titles, "RAM MB", "load s"), lines)}
"""


_READING = """\
Where `cohog` is ahead: no other way finds more on any set at the first place. aerial_brighton and aerial_copr are too
easy to tell ways apart. The seasons of grief_stromovka_seasons and nordland_tiny leave the others far behind. On
aerial_swindale ORB and SIFT with the ratio test miss one in ten, which so few queries hardly tell from none, and the
others much more. On kite_ochota SIFT-VLAD finds as many (and more among the first five), and the published
CoHOG and SIFT nearly as many. Encoding takes it a few milliseconds, as ORB, a sixth of the published way and less than
a tenth of SIFT. A place takes 144 or 200 bytes, where the others take thousands; only its own codes in FAISS are as
small, and those alone find much less.

Where it is not: matching. It compares places in full, and looking down also their landmarks, for a tenth to a fifth of
a second (looking ahead a twentieth), however small the map is. In the smallest maps here the ratio tests and the
published way are quicker, and one vector a place (bag of words, VLAD) is scanned in a fraction of a millisecond. It
needs more memory than ORB, and takes longer to load. Of the two sets with changed seasons it too misses one query in
six, and nearly every second one.

nordland_tiny has pictures of 64x32 pixels. ORB finds no features in those and SIFT a few, so its rows say nothing of
them on larger pictures. None of the other ways was tuned to these sets; all have the settings that a first try would
have. More features, or a check of the geometry, would find more and take longer.
"""

_LEFT_OUT = """## Looked at and left out

On PyPI, for Python 3.11:

* `dbow3py` 0.0.4: its source lacks the CMakeLists.txt that it is built with.
* `pydbow3`, `hbst-python`, `imret`: no file for this Python. `libviper`: from Python 3.12 on. hloc: not there.
* `vpr` 0.0.1: no place recognition, and its source lacks a file that it is installed with.
* `patchnetvlad` 0.1.8: asks for a package `faiss` that has no file for this Python, and its weights come
  from elsewhere.
* `vprtempo` 1.1.10: trains a network for every map; needs torchvision, which beside a PyTorch without CUDA cannot be
  imported from PyPI's file; and takes the n-th query for one of the n-th reference.
* `usearch`, `hnswlib`: find neighbours among vectors, and make none of a picture. The row of FAISS stands for them.

`pydbow` is the one that recognises places as it comes.
"""
