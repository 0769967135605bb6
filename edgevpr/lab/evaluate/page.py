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
from edgevpr.lab.evaluate.dataset import Dataset
from edgevpr.lab.evaluate.evaluate import QueryAnswer
from edgevpr.lab.evaluate.many import CURVE_TO, MeasuredRow, Measurements
from edgevpr.lab.evaluate.metrics import RESAMPLES, SEED
from edgevpr.lab.evaluate.provenance import machine, today, versions
from edgevpr.review.html import (
    Axis,
    Series,
    chart,
    data_url,
    figure,
    foreign,
    heading,
    notes,
    page,
    section,
    table,
)

_COLOURS = 8  # of lines; those after the eighth are dashed
_PICTURE_PX = 240
_MAX_MATCHES = 90  # on the page: each has three pictures of some 8 KB
_MIN_ROW_MATCHES = 2
_MAX_ROW_MATCHES = 8
_SHARES = Axis(0.0, 1.0, [(0.0, "0"), (0.2, "0.2"), (0.4, "0.4"), (0.6, "0.6"), (0.8, "0.8"), (1.0, "1")])
_METHOD = (
    f"95 %: the queries resampled {RESAMPLES} times (seed {SEED}); where all or none hit, by Clopper and Pearson. "
    "Times are of one thread, beside as many workers as are named."
)

Numbered = tuple[int, MeasuredRow]  # a row after its number, which is the same on the whole page


def write_results(folder: Path, outcome: Measurements) -> None:
    """Write results.json and index.html into `folder`."""
    contents = {"results.json": json.dumps(as_json(outcome), indent=1) + "\n", "index.html": format_page(outcome)}
    for name, content in contents.items():
        write_whole(folder / name, partial(Path.write_text, data=content, encoding="utf-8", errors="backslashreplace"))


def as_json(outcome: Measurements) -> dict[str, Any]:
    """Return all results, with date, machine and versions, for `json.dumps`."""
    return {
        "date": today(),
        "machine": machine(),
        "versions": versions(),
        "sets": {name: asdict(set_plan) for name, set_plan in outcome.plan.sets.items()},
        "results": [
            {"set": name, "row": row.label, **asdict(row.result), "recall_at_k": row.recalls, "made": row.made}
            for name, rows in outcome.found.items()
            for row in rows
        ],
        "failed": [{"set": name, "row": row, "why": why} for (name, row), why in outcome.failed.items()],
    }


def format_page(outcome: Measurements) -> str:
    """Return the whole page. Its style and pictures are inside: it loads no other file."""
    labels = list(dict.fromkeys(row.label for row in outcome.rows))
    facts = [f"sets: {len(outcome.sets)}", f"rows: {len(labels)}", f"written on {today()}"]
    made = dict.fromkeys(
        f"{row.made['date']}, {row.made['machine']['cpu']}, {row.made['workers']} of {row.made['machine']['cores']} "
        f"cores, edgevpr {row.made['versions']['edgevpr']}."
        for row in outcome.rows
    )
    body = [
        heading("Evaluation", [*facts, f"edgevpr {versions()['edgevpr']}"]),
        notes(f"{label} was not measured on {name}: {why}" for (name, label), why in outcome.failed.items()),
        section("All sets", _compare_sets(outcome, labels)),
        *(_describe_set(name, outcome, labels) for name, rows in outcome.found.items() if rows),
        section("How it was measured", _paragraphs([*made, _METHOD])),
    ]
    return page("Evaluation", Path(__file__).with_name("page.css"), body)


def _compare_sets(outcome: Measurements, labels: Sequence[str]) -> str:
    """Return a table of recall@1 of every row on every set; "" if there is one set, whose own table has it."""
    if len(outcome.sets) < 2:
        return ""
    found = [{row.label: row.result.recall_at_1 for row in rows} for rows in outcome.found.values()]
    rows = [
        [_name(label, number), *(tables.share_text(recalls.get(label)) for recalls in found)]
        for number, label in enumerate(labels, start=1)
    ]
    return "<p>Recall@1 on every set.</p>" + table(["row", *map(foreign, outcome.sets)], rows, str)


def _describe_set(name: str, outcome: Measurements, labels: Sequence[str]) -> str:
    dataset, camera = outcome.sets[name], outcome.plan.sets[name].camera
    rows = [(labels.index(row.label) + 1, row) for row in outcome.found[name]]
    per_row = max(_MIN_ROW_MATCHES, min(_MAX_ROW_MATCHES, _MAX_MATCHES // len(outcome.rows)))
    quality = [[_name(row.label, number), *tables.quality(row.result)] for number, row in rows]
    costs = [[_name(row.label, number), *tables.costs(row.result), row.made["date"]] for number, row in rows]
    matches = "".join(_show_matches(dataset, row, number, per_row) for number, row in rows)
    sentences = [*tables.list_notes([row.result for _, row in rows]), *([f"Camera: {camera}."] if camera else [])]
    return section(
        foreign(name),
        table(("row", *tables.QUALITY), quality, str)
        + f'<div class="charts">{"".join(_draw_charts(rows))}</div>'
        + "<h3>Costs</h3>"
        + table(("row", *tables.COSTS, "measured"), costs, str)
        + _paragraphs(sentences)
        + "<h3>Matches</h3>"
        + matches.replace("<details>", "<details open>", 1),
    )


def _draw_charts(rows: Sequence[Numbered]) -> Iterator[str]:
    curves = [
        Series("", _line_class(number), [(recall, precision) for precision, recall in row.result.precision_recall])
        for number, row in rows
    ]
    yield chart("Precision over recall", "", curves, _SHARES, top=1.0)
    last = len(rows[0][1].recalls)
    at_k = [Series("", _line_class(number), list(enumerate(row.recalls, start=1))) for number, row in rows]
    axis = Axis(1, last, [(k, str(k)) for k in (1, 5, 10, 15, 20, CURVE_TO) if k <= last])
    yield chart("Recall@K", f"over K, to {last}", at_k, axis, top=1.0)


def _show_matches(dataset: Dataset, row: MeasuredRow, number: int, most: int) -> str:
    """Return about `most` matches of a row, with their pictures: wrong ones, highest scores first, then right ones,
    lowest scores first. `number` sets the colour of the row's name."""
    wrong = sorted((answer for answer in row.answers if not answer.is_right), key=lambda answer: -answer.score)
    right = sorted((answer for answer in row.answers if answer.is_right), key=lambda answer: answer.score)
    shown = "".join(_show_match(dataset, answer) for answer in [*wrong[:most], *right[: max(1, most - len(wrong))]])
    summary = f"<summary>{_name(row.label, number)}: {len(wrong)} of {len(row.answers)} wrong</summary>"
    return f"<details>{summary}<div class='matches'>{shown}</div></details>"


def _show_match(dataset: Dataset, answer: QueryAnswer) -> str:
    (query,) = [query for query in dataset.queries if query.path.name == answer.query]
    pictures = _picture("query", query.path)
    pictures += _picture("found", dataset.ref_dir / answer.found) if answer.found else "<figure>found: none</figure>"
    accepted = "accepted" if answer.accepted else "not accepted"
    kind, verdict = "", "right"
    if not answer.is_right:
        pictures += _picture("right", dataset.ref_dir / min(query.right, key=counting_order))
        rank = "not found" if math.isinf(answer.first_right) else f"number {answer.first_right + 1:.0f}"
        kind, verdict = "wrong", f"wrong, the right one is {rank}"
        accepted = f'<b class="bad">{accepted}</b>' if answer.accepted_wrong else accepted
    return (
        f'<div class="match {kind}"><p><b>{verdict}</b>, score {figure(answer.score)}, {accepted}</p>'
        f'<div class="pair">{pictures}</div></div>\n'
    )


def _picture(role: str, path: Path) -> str:
    name, jpeg = foreign(path.name), small_jpeg(read_image(path), _PICTURE_PX)
    image = f'<img alt="{name}" src="{data_url("jpeg", jpeg)}">'
    return f"<figure>{image}<figcaption>{role}: {name}</figcaption></figure>"


def _paragraphs(sentences: Sequence[str]) -> str:
    return "".join(f'<p class="soft">{foreign(sentence)}</p>' for sentence in sentences)


def _line_class(number: int) -> str:
    dash, colour = divmod(number - 1, _COLOURS)
    return f"row{colour} dash{dash % 3}"


def _name(label: str, number: int) -> str:
    return f'<span class="name"><span class="number {_line_class(number)}">{number}</span>{foreign(label)}</span>'
