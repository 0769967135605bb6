"""Tests that every script loads, and that pages and shipped files match the results they are made from."""

import importlib
import json
import math
import re
from pathlib import Path

import base
import figures_page
import pytest
import thesis_page
import thesis_values
from arm64 import counted

from edgevpr.runtime.preflight.estimate import COUNTED_PATH

BENCHMARKS = Path(base.__file__).parent
PAGES = {
    "arm64": "bench_arm64",
    "bench": "bench",
    "confidence": "confidence",
    "flights": "flights",
    "hostile": "hostile",
    "salience": "bench_salience",
    "sites": "sites",
    "sweeps": "sweeps",
    "where": "where",
}


def load_script(name: str):
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name in ("torch", "cosmic_ray"):
            pytest.skip(f"{error.name} is not installed")
        raise


@pytest.mark.parametrize("name", sorted(path.stem for path in BENCHMARKS.glob("*.py")))
def test_scripts_can_be_loaded(name):
    assert load_script(name).__doc__


@pytest.mark.parametrize("name", PAGES)
def test_page_matches_its_results(name):
    page = (base.RESULTS / f"{name}.md").read_text("utf-8")
    assert load_script(PAGES[name]).format_page(base.read(name)).strip() + "\n" == page


def test_thesis_page_matches_its_results():
    page = thesis_page.format_page(thesis_values.read_results(base.RESULTS))
    assert (base.REPOSITORY / "docs" / "thesis.md").read_text("utf-8") == page, "python benchmarks/thesis.py --page"


def test_figures_page_matches_its_results(tmp_path):
    page, copy = base.REPOSITORY / "docs" / "figures.md", tmp_path / "figures.md"
    copy.write_text(page.read_text("utf-8"), "utf-8")
    figures_page.write_figures(copy)
    assert copy.read_text("utf-8") == page.read_text("utf-8"), "python benchmarks/figures_page.py"


def test_pages_link_only_existing_pictures():
    for page in base.RESULTS.glob("*.md"):
        for picture in re.findall(r"!\[[^]]*\]\(([^)]+)\)", page.read_text("utf-8")):
            assert (base.RESULTS / picture).is_file(), (page.name, picture)


def test_shipped_counts_match_the_benchmark():
    parts = {row["part"]: row["instructions"] for row in base.read("arm64")["parts"]}
    assert counted.compute_counts(parts) == json.loads(COUNTED_PATH.read_text())


def test_bound_formula_covers_what_printed_digits_were_rounded_from():
    value, least, most = thesis_values.bound_formula(lambda a, b: a * b, ["0.50", "20"])
    assert (value, least, most) == pytest.approx((10, 0.495 * 19.5, 0.505 * 20.5))


def test_compute_table_pcu_uses_printed_numbers():
    assert thesis_values.compute_table_pcu("CoHOG")[0] == pytest.approx(0.84 * math.log10(0.83 / 0.02 + 9))
    assert thesis_values.compute_table_pcu("AMOSNet")[2] is None  # it was trained on that set
    assert thesis_values.compute_table_pcu("Cross-Region-BoW")[1] == pytest.approx(0.81)  # the slowest: its precision
