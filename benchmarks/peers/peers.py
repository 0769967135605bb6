"""edgevpr's `cohog` beside what a researcher would reach for first: `make peers`.

python benchmarks/peers/peers.py [--sets A,B]

Every way recognises the same queries among the same references, each in a process of its own; of a set one way comes
after the other, so that a busy machine is busy for all. Words are learnt on the references of sets that are not
reported. A way whose package is missing is left out, and said.
"""

import argparse
import json
import pickle
import subprocess
import sys
import textwrap
from pathlib import Path
from tempfile import TemporaryDirectory

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import base
from base import Row, camera_of
from one import grey
from ways import WAYS

from edgevpr.core.text import markdown
from edgevpr.frames.source import open_source
from edgevpr.lab.evaluate import evaluate
from edgevpr.techniques import create

SETS = "aerial_brighton", "aerial_copr", "aerial_swindale", "kite_ochota", "grief_stromovka_seasons", "nordland_tiny"
LEARNT_ON = "corridor", "aerial_caliterra", "aerial_garfield28"
OURS = "cohog (edgevpr)"
_COSTS = {
    "t_e ms": "{t_encode_ms:.1f}",
    "t_m ms": "{t_match_ms:.1f}",
    "B/place": "{bytes:,.0f}",
    "RAM MB": "{ram_mb:.0f}",
    "import s": "{import_s:.2f}",
}
_COLUMNS = {
    "way": "{way}",
    "recall@1": "{quality[recall_at_1]:.3f}",
    "95 %": "{quality[recall_at_1_interval][0]:.2f}-{quality[recall_at_1_interval][1]:.2f}",
    "@5": "{quality[recall_at_5]:.3f}",
    "P@100%R": "{quality[precision_at_100_recall]:.3f}",
    "R@100%P": "{quality[recall_at_100_precision]:.3f}",
    "AUC": "{quality[auc]:.3f}",
    **_COSTS,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", default=",".join(SETS), metavar="A,B")
    folders = base.find_sets(names=parser.parse_args().sets.split(","))
    references = [path for folder in base.find_sets(names=LEARNT_ON) for path in sorted((folder / "ref").iterdir())]
    training = [grey(path) for path in references]
    found = {"rows": {}} | base.read("peers") | base.made_by()
    with TemporaryDirectory(prefix="edgevpr-peers-") as name:
        for way, make in WAYS.items():
            try:
                (Path(name) / way).write_bytes(pickle.dumps(make().learn(training)))
            except ModuleNotFoundError as error:
                print(f"{way} is left out: {error}", file=sys.stderr, flush=True)
        ways = [path.name for path in Path(name).iterdir()]
        for folder in folders:
            camera, images, place_map = camera_of(folder.name), folder / "ref", Path(name) / f"{folder.name}.gpkg"
            frames = evaluate.all_frames(open_source(str(images), live=False))
            evaluate.make_map(place_map, frames, create("cohog", {"camera": camera}), images)
            rows = {OURS: _one("cohog", camera, folder, place_map)}
            rows |= {way: _one("way", way, folder, Path(name) / way) for way in ways}
            found["rows"] |= {f"{folder.name}: {way}": row | {"commit": found["commit"]} for way, row in rows.items()}
            base.write("peers", found, page(found))


def _one(*words: object) -> Row:
    """Do one piece of work in a process of its own."""
    argv = [sys.executable, Path(__file__).with_name("one.py"), *words]
    return json.loads(subprocess.run([*map(str, argv)], stdout=subprocess.PIPE, check=True).stdout)


def page(found: Row) -> str:
    """Return the page of all that was found."""
    machine, rows = found["machine"], found["rows"]
    of_set = {
        name: {way: rows[key] for way in (OURS, *WAYS) if (key := f"{name}: {way}") in rows}
        for name in sorted({key.partition(": ")[0] for key in rows})
    }
    commits = sorted({row["commit"] for row in rows.values()})
    recalls = [
        [way, *(base.cell("{quality[recall_at_1]:.2f}", each.get(way, {})) for each in of_set.values())]
        for way in (OURS, *WAYS)
    ]
    heads = [f"{name} ({next(iter(each.values()))['quality']['queries']})" for name, each in of_set.items()]
    kept_kb = [row["file_bytes"] / 1e3 for row in rows.values() if "file_bytes" in row]
    sections = [
        f"### {name}\n\n{{queries}} queries, {{references}} references.\n\n".format(**each[OURS]["quality"])
        + base.table([{"way": way, **row} for way, row in each.items()], _COLUMNS)
        for name, each in of_set.items()
    ]
    parts = (
        "# Beside other ways",
        f"Made by `make peers`, {found['date']}, commits {', '.join(commits)}, {machine['cores']} cores of "
        f"{machine['cpu']}, OpenCV {machine['opencv']}.",
        _ABOUT_RECALL.strip(),
        markdown(("way", *heads), recalls),
        _READING.strip(),
        "## Costs",
        " ".join(_ABOUT_COSTS.split()).format(least=min(kept_kb), most=max(kept_kb)),
        *sections,
        _LEFT_OUT.strip(),
    )
    return "\n\n".join(each if each[0] in "#|*" or "\n" in each else textwrap.fill(each, 120) for each in parts)


_ABOUT_RECALL = """\
Recall@1 on the sets that `cohog` was not tuned on ([sets.md](sets.md) names what they had a say in all the same); in
brackets the queries. Looking down `cohog` is told so, and knows neither heading nor height. Every way has the same
queries and the same references, in the sizes of the set.
"""
_ABOUT_COSTS = """\
Times are those of the processor, on one thread, medians over the queries: `t_e` encodes a query, `t_m` matches it with
all references. The machine was busy: of two runs, on five of the sets, all answers were the same, and the times of a
row differed by less than a fifth as a rule, by a half at most. `B/place` is what the index takes in memory: for the
published CoHOG and for the ratio tests that is the whole descriptor of every reference. `cohog` has besides {least:.0f}
to {most:.0f} KB a place in its map file, of which a match reads the places that it compares. `RAM` is the peak of the
process above the bare interpreter, with the references in it; maps and words were made before, by another process.
`import` are the seconds of the processor until the libraries are loaded. Words (bag of words, VLAD) are learnt
on the references of corridor, aerial_caliterra and aerial_garfield28. The 95 % are of recall@1: what other queries of
the same kind would give. Of a set at most 200 queries are asked, evenly spaced.
"""
_READING = """\
Where `cohog` is ahead: no other way finds more on any set at the first place. aerial_brighton and aerial_copr are too
easy to tell ways apart. The seasons of grief_stromovka_seasons and nordland_tiny leave the others far behind. On
aerial_swindale ORB and SIFT with the ratio test miss one in ten, which so few queries hardly tell from none, and the
others much more. On kite_ochota SIFT-VLAD finds as many (and more among the first five), and the published
CoHOG and SIFT nearly as many. Encoding takes it a few milliseconds, as ORB, a sixth of the published way and less than
a tenth of SIFT. A place takes 144 or 1120 bytes, where the others take thousands; only its own codes in FAISS are as
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
* `pydbow`: recognises places as it comes, a tree of ORB words in Python, whose k-means goes through them one by one.
  The bag of ORB words stands for it.
"""

if __name__ == "__main__":
    base.run(main)
