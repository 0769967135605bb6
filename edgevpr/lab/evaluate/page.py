"""The page of an evaluation: tables, curves, costs, and the matches that went wrong, to look at."""

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from edgevpr.core.errors import ImageError
from edgevpr.core.text import decoded_name
from edgevpr.frames.images import counting_order, list_images, read_image, small_jpeg
from edgevpr.lab.evaluate import tables
from edgevpr.lab.evaluate.asking import QueryAnswer
from edgevpr.lab.evaluate.many import CURVE_TO, Made, MeasuredRow, Measurements, OpenSet
from edgevpr.lab.evaluate.metrics import RESAMPLES, SEED
from edgevpr.lab.evaluate.provenance import commit_of, program, today, versions
from edgevpr.review.html import foreign, heading, notes, page, picture, section, table
from edgevpr.review.svg import Axis, Series, chart, figure, scatter

_COLOURS = 8  # then the lines are dashed
_PICTURE_PX = 240
_MOST_MATCHES = 90  # of the page: each has three pictures of some 8 KB
_OF_A_ROW = 2, 8  # matches, at least and at most

_SHARES = Axis(0.0, 1.0, [(0.0, "0"), (0.2, "0.2"), (0.4, "0.4"), (0.6, "0.6"), (0.8, "0.8"), (1.0, "1")])
_HEADINGS = ("row", "recall@1", "95 %", "@5", "@10", "AUC", "P@100%R", "R@100%P", "PCU", "accepted (wrong)")
_COSTS = ("row", "encode ms", "match ms", "RAM B/place", "disk B/place", "mAh/query", "measured")


def page_of(outcome: Measurements) -> str:
    """Return the page: HTML with all that it shows inside."""
    labels = list(dict.fromkeys(each.label for each in outcome.found))
    numbers = {label: at for at, label in enumerate(labels, start=1)}
    most = max(_OF_A_ROW[0], min(_OF_A_ROW[1], _MOST_MATCHES // max(1, len(outcome.found))))
    body = [
        _head(outcome),
        notes(_notes(outcome)),
        section("All sets", _over_sets(outcome, numbers)),
        *(_of_set(at, of, outcome.found, numbers, most) for at, of in enumerate(outcome.sets, start=1)),
        section("How it was measured", _how(outcome, numbers)),
    ]
    return page("Evaluation", Path(__file__).with_name("page.css"), body)


def _head(outcome: Measurements) -> str:
    rows = len({each.label for each in outcome.found})
    known = [
        f"{len(outcome.sets)} {'set' if len(outcome.sets) == 1 else 'sets'}",
        f"{rows} {'row' if rows == 1 else 'rows'}",
        f"written on {today()}",
        program(versions(), commit_of()),
    ]
    return heading("Evaluation", known)


def _notes(outcome: Measurements) -> Iterator[str]:
    for (of, row), why in outcome.failed.items():
        yield f"{row} was not measured on {of}: {why}"
    if kept := sum(row.made.was_kept for row in outcome.found):
        yield (
            f"{kept} of {len(outcome.found)} results were measured earlier: their times are of that day and that "
            "machine, which are named below."
        )
    if not all(row.result.recall_at_1_interval for row in outcome.found):
        yield "SciPy is not installed: there are no intervals."


def _over_sets(outcome: Measurements, numbers: dict[str, int]) -> str:
    """Return recall@1 of every row on every set; nothing for one set, which says so itself."""
    if len(outcome.sets) < 2:
        return ""
    found = {(each.label, each.set_name): each.result.recall_at_1 for each in outcome.found}
    rows = []
    for label in numbers:
        shares = [found.get((label, of.name)) for of in outcome.sets]
        known = [share for share in shares if share is not None]
        cells = ["-" if share is None else f"{share:.3f}" for share in shares]
        mean = f"{sum(known) / len(known):.3f}" if len(known) == len(shares) else "-"
        rows.append([_name(label, numbers), *cells, f"<b>{mean}</b>"])
    names = [f'<a href="#set-{at}">{foreign(of.name)}</a>' for at, of in enumerate(outcome.sets, start=1)]
    return "<p>Recall@1 on every set, and the mean of the sets.</p>" + table(["row", *names, "mean"], rows, str)


def _of_set(at: int, of: OpenSet, everything: Sequence[MeasuredRow], numbers: dict[str, int], most: int) -> str:
    found = [each for each in everything if each.set_name == of.name]
    dataset, title = of.dataset, f'<span id="set-{at}">{foreign(of.name)}</span>'
    camera = {"nadir": ", camera straight down", "forward": ", camera ahead"}.get(of.plan.camera or "", "")
    said = f"{len(dataset.queries)} queries scored against {len(dataset.references)} references{camera}"
    if not found:
        return section(title, f'<p class="soft">{said}</p><p>No row was measured on it.</p>')
    recalls = len(found[0].recalls)
    drawn = [
        chart(
            "Precision over recall",
            "",
            [
                Series(
                    "", _look(each, numbers), [(recall, precise) for precise, recall in each.result.precision_recall]
                )
                for each in found
            ],
            _SHARES,
            top=1.0,
        ),
        chart(
            "Recall@K",
            f"over K, to {recalls}",
            [Series("", _look(each, numbers), list(enumerate(each.recalls, start=1))) for each in found],
            Axis(1, recalls, [(k, str(k)) for k in (1, 5, 10, 15, 20, CURVE_TO) if k <= recalls]),
            top=1.0,
        ),
        _against("Recall@1 over charge", "mAh a query", found, numbers, _mah),
        _against("Recall@1 over memory", "bytes of RAM a place", found, numbers, _bytes),
    ]
    rows = [_quality(each, numbers) for each in found]
    costs = [_costs(each, numbers) for each in found]
    return section(
        title,
        f'<p class="soft">{said}</p>'
        + table(_HEADINGS, rows, str)
        + _intervals(found, numbers)
        + f'<div class="charts">{"".join(drawn)}</div>'
        + "<h3>Costs</h3>"
        + table(_COSTS, costs, str)
        + "<h3>Matches</h3>"
        + "".join(_matches(of, each, numbers, most, not at) for at, each in enumerate(found)),
    )


def _quality(each: MeasuredRow, numbers: dict[str, int]) -> list[str]:
    first, within, five, _, ten, _, precise, recalled, area, *_ = tables.quality(each.result)
    shares = [f"<b>{first}</b>", within, five, ten, area, precise, recalled]
    return [_name(each.label, numbers), *shares, *tables.decided(each.result)]


def _costs(each: MeasuredRow, numbers: dict[str, int]) -> list[str]:
    result, made = each.result, each.made
    return [
        _name(each.label, numbers),
        f"{1000 * result.t_encode_s:.1f}",
        f"{1000 * result.t_match_s:.1f}",
        f"{result.descriptor_bytes:,}",
        f"{result.fine_bytes:,}",
        figure(_mah(each)),
        f"{'earlier: ' if made.was_kept else ''}{made.date}",
    ]


def _intervals(found: Sequence[MeasuredRow], numbers: dict[str, int]) -> str:
    """Draw recall@1 of every row as a bar, with the interval that 95 % of other queries would give."""
    lines = ""
    for each in found:
        share, within = each.result.recall_at_1, each.result.recall_at_1_interval
        whisker = ""
        if within:
            low, high = within
            whisker = f'<i style="left:{100 * low:.1f}%;width:{100 * (high - low):.1f}%"></i>'
        lines += (
            f'<span>{_name(each.label, numbers)}</span><div class="bar {_look(each, numbers)}">'
            f'<u style="width:{100 * share:.1f}%"></u>{whisker}</div><span class="soft">{share:.2f}</span>'
        )
    return f'<h3>Recall@1, and its 95 % interval</h3><div class="bars">{lines}</div>'


def _against(
    title: str, unit: str, found: Sequence[MeasuredRow], numbers: dict[str, int], cost: Callable[[MeasuredRow], float]
) -> str:
    """Draw recall@1 over a cost, which has an axis of powers of ten."""
    points = [
        (math.log10(cost(each)), each.result.recall_at_1, str(numbers[each.label]), _look(each, numbers))
        for each in sorted(found, key=cost)
        if cost(each) > 0
    ]
    if not points:
        return ""
    low, high = math.floor(points[0][0]), math.ceil(points[-1][0])
    high = max(high, low + 1)
    ticks = [(float(power), _power(power)) for power in range(low, high + 1)]
    return scatter(title, unit, points, Axis(low, high, ticks), 1.0)


def _power(power: int) -> str:
    """Return a power of ten in few characters."""
    if power < -2:
        return "10⁻" + "".join("⁰¹²³⁴⁵⁶⁷⁸⁹"[int(digit)] for digit in str(-power))
    return f"{10.0**power:g}" if power < 3 else f"{10 ** (power % 3)} {' kMGT'[power // 3]}"


def _matches(of: OpenSet, each: MeasuredRow, numbers: dict[str, int], most: int, is_open: bool) -> str:
    """Show matches of a row: the wrong ones with the highest scores first, then the right ones with the lowest."""
    wrong = sorted((one for one in each.answers if not one.is_right), key=lambda one: -one.score)
    right = sorted((one for one in each.answers if one.is_right), key=lambda one: one.score)
    shown = [*wrong[:most], *right[: max(1, most - len(wrong))]]
    queries = {query.path.name: query for query in of.dataset.queries}
    references = {decoded_name(path.name): path for path in list_images(of.dataset.ref_dir)}
    content = ""
    for one in shown:
        query = queries[one.query]
        names = sorted(query.right, key=counting_order)
        more = f" (one of {len(names)})" if len(names) > 1 else ""
        pictures = [("query", query.path, ""), ("found", references.get(one.found or ""), "")]
        if not one.is_right:
            pictures.append(("right", references.get(names[0]), more))
        rank = "the right one is not found"
        if not math.isinf(one.first_right):
            rank = f"the right one is number {one.first_right + 1:.0f}"
        verdict = "right" if one.is_right else f"wrong, {rank}"
        content += (
            f'<div class="match {"" if one.is_right else "wrong"}"><p><b>{verdict}</b>, score {figure(one.score)}'
            f'{_flown(one)}</p><div class="pair">{"".join(_picture(*each) for each in pictures)}</div></div>\n'
        )
    counted = f"{len(wrong)} of {len(each.answers)} wrong"
    summary = f"<summary>{_name(each.label, numbers)}: {counted}</summary>"
    return f"<details{' open' if is_open else ''}>{summary}<div class='matches'>{content}</div></details>"


def _flown(answer: QueryAnswer) -> str:
    if answer.accepted_wrong:
        return ', <b class="bad">accepted</b>'
    return ", accepted" if answer.accepted else ", not accepted"


def _picture(what: str, path: Path | None, more: str) -> str:
    if path is None:
        return f"<figure><figcaption>{what}: none</figcaption></figure>"
    try:
        return picture(path.name, f"{what}: {path.name}{more}", small_jpeg(read_image(path), _PICTURE_PX))
    except ImageError:  # it was there when it was measured
        return f"<figure><figcaption>{what}: {foreign(path.name)} (gone)</figcaption></figure>"


def _how(outcome: Measurements, numbers: dict[str, int]) -> str:
    stories: dict[str, list[str]] = {}
    for each in outcome.found:
        stories.setdefault(_story(each.made), []).append(f"{each.set_name}: {each.label}")
    items = "".join(
        f"<details><summary>{foreign(said)} ({len(of)} {'result' if len(of) == 1 else 'results'})</summary>"
        f"<p>{foreign('; '.join(of))}</p></details>"
        for said, of in stories.items()
    )
    assumed = dict.fromkeys(f"mAh: {each.result.ah_assumes}." for each in outcome.found)
    weights = dict.fromkeys(f"Weights of {each.result.weights}." for each in outcome.found if each.result.weights)
    fixed = [
        f"95 %: of {RESAMPLES} times that the queries were resampled (seed {SEED}); where all or none hit, the exact "
        "interval of Clopper and Pearson.",
        "Times are means over the queries, each on one thread, beside as many workers as are named. Recall counts "
        "queries whose status is ok; a match that is only loosely right counts neither way.",
        *assumed,
        *weights,
    ]
    return items + "".join(f'<p class="soft">{foreign(said)}</p>' for said in fixed)


def _story(made: Made) -> str:
    libraries = ", ".join(f"{name} {found or 'missing'}" for name, found in made.versions.items() if name != "edgevpr")
    return f"{made.story}; {program(made.versions, made.commit)}, {libraries}"


def _mah(each: MeasuredRow) -> float:
    return 1000 * each.result.ah_total / each.result.queries


def _bytes(each: MeasuredRow) -> int:
    return each.result.descriptor_bytes


def _look(each: MeasuredRow, numbers: dict[str, int]) -> str:
    return _class(numbers[each.label])


def _class(number: int) -> str:
    turn, colour = divmod(number - 1, _COLOURS)
    return f"row{colour} dash{turn % 3}"


def _name(label: str, numbers: dict[str, int]) -> str:
    number = numbers[label]
    return f'<span class="name"><span class="number {_class(number)}">{number}</span>{foreign(label)}</span>'
