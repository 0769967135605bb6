"""Writes the results of `many` as files: results.json for programs, and index.html for people, a page of tables,
curves and examples of matches. Functions that return a str return HTML."""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

from edgevpr.core.files import write_whole
from edgevpr.frames.images import counting_order, read_image, small_jpeg
from edgevpr.lab.evaluate import tables
from edgevpr.lab.evaluate.asking import QueryAnswer
from edgevpr.lab.evaluate.dataset import Dataset
from edgevpr.lab.evaluate.many import CURVE_TO, MeasuredRow, Measurements
from edgevpr.lab.evaluate.metrics import RESAMPLES, SEED
from edgevpr.lab.evaluate.provenance import machine, today, versions
from edgevpr.review.html import (
    Axis,
    Series,
    chart,
    figure,
    foreign,
    heading,
    notes,
    page,
    picture,
    section,
    table,
)

_COLOURS = 8  # of lines; those after the eighth are dashed
_PICTURE_PX = 240
_MOST_MATCHES = 90  # on the page: each has three pictures of some 8 KB
_FEWEST_OF_A_ROW, _MOST_OF_A_ROW = 2, 8  # matches shown of one row
_SHARES = Axis(0.0, 1.0, [(0.0, "0"), (0.2, "0.2"), (0.4, "0.4"), (0.6, "0.6"), (0.8, "0.8"), (1.0, "1")])

Numbered = tuple[int, MeasuredRow]  # a row after its number, which is the same on the whole page


def write_results(folder: Path, outcome: Measurements) -> None:
    """Write results.json and index.html into `folder`."""
    contents = {"results.json": json.dumps(as_json(outcome), indent=1) + "\n", "index.html": page_of(outcome)}
    for name, content in contents.items():
        write_whole(folder / name, partial(Path.write_text, data=content, encoding="utf-8", errors="backslashreplace"))


def as_json(outcome: Measurements) -> dict[str, Any]:
    """Return all results, with date, machine and versions, for `json.dumps`."""
    return {
        "date": today(),
        "machine": machine(),
        "versions": versions(),
        "sets": {name: asdict(each) for name, each in outcome.plan.sets.items()},
        "results": [
            {"set": name, "row": row.label, **asdict(row.result), "recall_at_k": row.recalls, "made": row.made}
            for name, rows in outcome.found.items()
            for row in rows
        ],
        "failed": [{"set": of, "row": row, "why": why} for (of, row), why in outcome.failed.items()],
    }


def page_of(outcome: Measurements) -> str:
    """Return the whole page. Its style and pictures are inside: it loads no other file."""
    labels = list(dict.fromkeys(row.label for row in outcome.rows))
    known = [f"sets: {len(outcome.sets)}", f"rows: {len(labels)}", f"written on {today()}"]
    body = [
        heading("Evaluation", [*known, f"edgevpr {versions()['edgevpr']}"]),
        notes(f"{label} was not measured on {of}: {why}" for (of, label), why in outcome.failed.items()),
        section("All sets", _over_sets(outcome, labels)),
        *(_of_set(name, outcome, labels) for name in outcome.sets),
        section("How it was measured", _how(outcome)),
    ]
    return page("Evaluation", Path(__file__).with_name("page.css"), body)


def _over_sets(outcome: Measurements, labels: Sequence[str]) -> str:
    """Return a table of recall@1 of every row on every set; "" if there is one set, whose own table has it."""
    if len(outcome.sets) < 2:
        return ""
    found = [{row.label: row.result.recall_at_1 for row in rows} for rows in outcome.found.values()]
    rows = []
    for number, label in enumerate(labels, start=1):
        shares = [of_set.get(label) for of_set in found]
        known = [share for share in shares if share is not None]
        mean = sum(known) / len(shares) if len(known) == len(shares) else None
        rows.append([_name(label, number), *map(tables.share_text, shares), f"<b>{tables.share_text(mean)}</b>"])
    names = map(foreign, outcome.sets)
    return "<p>Recall@1 on every set, and the mean of the sets.</p>" + table(["row", *names, "mean"], rows, str)


def _of_set(name: str, outcome: Measurements, labels: Sequence[str]) -> str:
    dataset, camera = outcome.sets[name], outcome.plan.sets[name].camera
    rows = [(labels.index(row.label) + 1, row) for row in outcome.found[name]]
    scored = f"{len(dataset.queries)} queries scored against {len(dataset.references)} references"
    scored += f", camera {camera}" if camera else ""
    if not rows:
        return ""  # the notes say why
    most = max(_FEWEST_OF_A_ROW, min(_MOST_OF_A_ROW, _MOST_MATCHES // len(outcome.rows)))
    reached = [[_name(row.label, number), *tables.quality(row.result)] for number, row in rows]
    paid = [[_name(row.label, number), *tables.costs(row.result), row.made["date"]] for number, row in rows]
    matches = "".join(_matches(dataset, row, number, most) for number, row in rows)
    return section(
        foreign(name),
        f'<p class="soft">{scored}</p>'
        + table(("row", *tables.QUALITY), reached, str)
        + f'<div class="charts">{"".join(_charts(rows))}</div>'
        + "<h3>Costs</h3>"
        + table(("row", *tables.COSTS, "measured"), paid, str)
        + "<h3>Matches</h3>"
        + matches.replace("<details>", "<details open>", 1),
    )


def _charts(rows: Sequence[Numbered]) -> Iterator[str]:
    curves = [
        Series("", _look(number), [(recall, precise) for precise, recall in row.result.precision_recall])
        for number, row in rows
    ]
    yield chart("Precision over recall", "", curves, _SHARES, top=1.0)
    most = len(rows[0][1].recalls)
    at_k = [Series("", _look(number), list(enumerate(row.recalls, start=1))) for number, row in rows]
    axis = Axis(1, most, [(k, str(k)) for k in (1, 5, 10, 15, 20, CURVE_TO) if k <= most])
    yield chart("Recall@K", f"over K, to {most}", at_k, axis, top=1.0)


def _matches(dataset: Dataset, row: MeasuredRow, number: int, most: int) -> str:
    """Return about `most` matches of a row, with their pictures: wrong ones, highest scores first, then right ones,
    lowest scores first. `number` sets the colour of the row's name."""
    wrong = sorted((answer for answer in row.answers if not answer.is_right), key=lambda answer: -answer.score)
    right = sorted((answer for answer in row.answers if answer.is_right), key=lambda answer: answer.score)
    shown = "".join(_match(dataset, answer) for answer in [*wrong[:most], *right[: max(1, most - len(wrong))]])
    summary = f"<summary>{_name(row.label, number)}: {len(wrong)} of {len(row.answers)} wrong</summary>"
    return f"<details>{summary}<div class='matches'>{shown}</div></details>"


def _match(dataset: Dataset, answer: QueryAnswer) -> str:
    (query,) = [query for query in dataset.queries if query.path.name == answer.query]
    pictures = _picture("query", query.path) + _picture("found", answer.found and dataset.ref_dir / answer.found)
    accepted = "accepted" if answer.accepted else "not accepted"
    kind, verdict = "", "right"
    if not answer.is_right:
        names = sorted(query.right, key=counting_order)
        pictures += _picture("right", dataset.ref_dir / names[0], f" (one of {len(names)})" if len(names) > 1 else "")
        rank = "not found" if math.isinf(answer.first_right) else f"number {answer.first_right + 1:.0f}"
        kind, verdict = "wrong", f"wrong, the right one is {rank}"
        accepted = f'<b class="bad">{accepted}</b>' if answer.accepted_wrong else accepted
    return (
        f'<div class="match {kind}"><p><b>{verdict}</b>, score {figure(answer.score)}, {accepted}</p>'
        f'<div class="pair">{pictures}</div></div>\n'
    )


def _picture(what: str, path: Path | str | None, more: str = "") -> str:
    if not isinstance(path, Path):
        return f"<figure><figcaption>{what}: none</figcaption></figure>"
    return picture(path.name, f"{what}: {path.name}{more}", small_jpeg(read_image(path), _PICTURE_PX))


def _how(outcome: Measurements) -> str:
    results = [row.result for row in outcome.rows]
    made = (
        f"{row.made['date']}, {row.made['machine']['cpu']}, {row.made['workers']} of {row.made['machine']['cores']} "
        f"cores, edgevpr {row.made['versions']['edgevpr']}."
        for row in outcome.rows
    )
    sentences = [
        *made,
        f"95 %: the queries resampled {RESAMPLES} times (seed {SEED}); where all or none hit, by Clopper and Pearson. "
        "Times are means over the queries, each on one thread, beside as many workers as are named. Recall "
        "counts queries whose status is ok; a match that is only loosely right counts neither way.",
        *(f"Known of each query of {result.technique}: {result.known}." for result in results if result.known),
        *(f"mAh: {result.ah_assumes}." for result in results),
        *(f"Weights of {result.weights}." for result in results if result.weights),
    ]
    return "".join(f'<p class="soft">{foreign(sentence)}</p>' for sentence in dict.fromkeys(sentences))


def _look(number: int) -> str:
    turn, colour = divmod(number - 1, _COLOURS)
    return f"row{colour} dash{turn % 3}"


def _name(label: str, number: int) -> str:
    return f'<span class="name"><span class="number {_look(number)}">{number}</span>{foreign(label)}</span>'
