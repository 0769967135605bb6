"""Values of the thesis (thesis.yaml), results of this project, and values computed from the thesis's own inputs."""

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
# Label of the row of the results, by the thesis's name of the technique. Its CALC has the authors' weights.
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
# Name of the author's published matrix, by the thesis's name of the technique.
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
    """Results that the page needs: image sets by name, `make bench`, the salience gate, and `make thesis`."""

    sets: dict[str, dict[str, Any]]
    bench: dict[str, Any]
    salience: dict[str, Any]
    thesis: dict[str, Any]


def read_results(folder: Path) -> Results:
    """Read these results from a folder."""
    sets = {content["set"]: content for content in sets_page.read_sets(folder)}
    return Results(sets, *(base.read(name, folder) for name in ("bench", "salience", "thesis")))


def bound_formula(formula: Callable[..., float], printed: Iterable[str]) -> tuple[float, float, float]:
    """Return the value of a formula for `printed` numbers, and its least and greatest value for numbers that round to
    them. The formula must be monotonic in each number."""
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


def half_digit(text: str) -> float:
    """Return half a unit of the last digit of a printed number."""
    return float(Decimal(1).scaleb(Decimal(text).as_tuple().exponent) / 2)


def total_ah(u_encode: float, u_match: float, t_encode_s: float, t_match_s: float) -> float:
    """Return Ah_t (5.7) of N queries on the thesis's server, by the power model of this project."""
    table, board = THESIS["table_5_2"], load_board(XEON_BOARD)
    energy_j = stage_energy_j(board.idle_w, board.full_w, u_encode, t_encode_s)
    energy_j += stage_energy_j(board.idle_w, board.full_w, u_match, t_match_s)
    return queries_ah(table["queries"], energy_j / (3600 * table["rail_v"]))


def compute_table_pcu(technique: str) -> list[float | None]:
    """Return the PCU of a technique on each set of table 6.1 (the bars of figure 6.6; None: no value)."""
    table = THESIS["table_6_1"]
    *precisions, t_encode_s, _ = table["techniques"][technique]
    slowest_s = float(table["slowest_s"])
    return [None if value is None else metrics.pcu(float(value), float(t_encode_s), slowest_s) for value in precisions]


def compute_pcu(rows: dict[str, dict[str, Any]]) -> dict[str, float]:
    """Return the PCU of each row (`precision_at_100_recall`, `t_encode_s`), relative to the slowest of them."""
    slowest_s = max(row["t_encode_s"] for row in rows.values())
    return {
        name: metrics.pcu(row["precision_at_100_recall"], row["t_encode_s"], slowest_s) for name, row in rows.items()
    }


def select_rows(results: Results, name: str) -> dict[str, dict[str, Any]]:
    """Return the rows of a set, by the thesis's names of the techniques, with `cohog` as it flies."""
    techniques = results.sets[name]["techniques"]
    rows = {thesis_name: techniques[label] for thesis_name, label in ROWS.items() if label in techniques}
    return {**rows, "cohog, as it flies": techniques["cohog"]}
