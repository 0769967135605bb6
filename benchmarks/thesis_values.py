"""The values of the thesis, from thesis.yaml, this project's results, and what follows from the thesis's own inputs."""

import itertools
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from decimal import Decimal
from pathlib import Path
from typing import Any

import base
import sets_page
import yaml

from edgevpr.lab.evaluate import metrics
from edgevpr.power.boards import load_board
from edgevpr.power.equations import queries_ah, stage_energy_j

THESIS = yaml.safe_load(Path(__file__).with_suffix(".yaml").with_stem("thesis").read_text(encoding="utf-8"))
# The thesis's names, by those of the rows of the results. Its CALC is the one with the authors' weights.
ROWS = {
    "HOG": "hog",
    "AlexNet": "alexnet",
    "AMOSNet": "amosnet",
    "HybridNet": "hybridnet",
    "CALC": "calc, original weights",
    "Cross-Region-BoW": "cross_region_bow",
    "NetVLAD": "netvlad",
    "Region-VLAD": "region_vlad",
    "R-MAC": "rmac",
    "CoHOG": "cohog, thesis",
}
# The names of the matrices that the author published.
MATRICES = {
    "HOG": "HOG",
    "AlexNet": "AlexNet_VPR",
    "AMOSNet": "AMOSNet",
    "HybridNet": "HybridNet",
    "CALC": "CALC",
    "NetVLAD": "NetVLAD",
    "Region-VLAD": "RegionVLAD",
    "CoHOG": "CoHOG",
}
XEON_BOARD = "thesis-xeon"


@dataclass(frozen=True, slots=True)
class Results:
    """The results that the page is made of: image sets by name, those of `make bench`, of the gate, and of
    `make thesis`."""

    sets: dict[str, dict[str, Any]]
    bench: dict[str, Any]
    salience: dict[str, Any]
    thesis: dict[str, Any]


def read_results(folder: Path) -> Results:
    """Read the results of a folder."""
    sets = {content["set"]: content for content in sets_page.read_sets(folder)}
    return Results(sets, *(base.read(name, folder) for name in ("bench", "salience", "thesis")))


def bound_formula(formula: Callable[..., float], printed: Iterable[str]) -> tuple[float, float, float]:
    """Return what a formula makes of printed numbers, and the least and the most it can make of the numbers that they
    were rounded from; the formula is monotonic in each."""
    texts = list(printed)
    ends = [(float(text) - half_digit(text), float(text) + half_digit(text)) for text in texts]
    values = [formula(*corner) for corner in itertools.product(*ends)]
    return formula(*map(float, texts)), min(values), max(values)


def format_3g(value: float | None, factor: float = 1.0) -> str:
    """Format a number, times `factor`, with three significant digits and without an exponent."""
    if value is None:
        return "-"
    rounded = float(f"{value * factor:.3g}")
    return f"{rounded:,.0f}" if rounded >= 1000 else f"{rounded:g}"


def capitalise(text: str) -> str:
    """Begin a text with a capital."""
    return text[:1].upper() + text[1:]


def half_digit(text: str) -> float:
    """Return half a unit of the last digit of a printed number."""
    return float(Decimal(1).scaleb(Decimal(text).as_tuple().exponent) / 2)


def total_ah(u_encode: float, u_match: float, t_encode_s: float, t_match_s: float) -> float:
    """Compute Ah_t (5.7) by the power model of this project on the thesis's server, for N queries."""
    table, board = THESIS["table_5_2"], load_board(XEON_BOARD)
    energy_j = stage_energy_j(board.idle_w, board.full_w, u_encode, t_encode_s)
    energy_j += stage_energy_j(board.idle_w, board.full_w, u_match, t_match_s)
    return queries_ah(table["queries"], energy_j / (3600 * table["rail_v"]))


def compute_table_pcu(technique: str) -> list[float | None]:
    """Return the PCU of a technique of table 6.1 on each of its sets: the bars of figure 6.6."""
    table = THESIS["table_6_1"]
    *precisions, t_encode_s, _ = table["techniques"][technique]
    slowest_s = float(table["slowest_s"])
    return [None if value is None else metrics.pcu(float(value), float(t_encode_s), slowest_s) for value in precisions]


def compute_pcu(rows: dict[str, dict[str, Any]]) -> dict[str, float]:
    """Return the PCU of rows with `precision_at_100_recall` and `t_encode_s`, against the slowest of them."""
    slowest_s = max(row["t_encode_s"] for row in rows.values())
    return {
        name: metrics.pcu(row["precision_at_100_recall"], row["t_encode_s"], slowest_s) for name, row in rows.items()
    }


def select_rows(results: Results, name: str) -> dict[str, dict[str, Any]]:
    """Return the rows of a set by the thesis's names of the techniques, and `cohog` as it flies."""
    techniques = results.sets[name]["techniques"]
    rows = {thesis_name: techniques[label] for thesis_name, label in ROWS.items() if label in techniques}
    return {**rows, "cohog, as it flies": techniques["cohog"]}
