"""Sections of docs/thesis.md on costs, in the thesis and here: charge, times, memory, PCU."""

import thesis_values as values
from base import format_markdown_table
from thesis_values import MATRICES, ROWS, THESIS, Results, compute_table_pcu, format_3g, select_rows

FLOAT_BYTES = 4


def format_charge() -> str:
    """Return the section on table 5.2: the power model with the thesis's own inputs."""
    table = THESIS["table_5_2"]
    rows = []
    for name, (*inputs, printed_ah) in table["techniques"].items():
        ours, least, most = values.bound_formula(values.total_ah, inputs)
        theirs, half = float(printed_ah), values.half_digit(printed_ah)
        fits = least <= theirs + half and theirs - half <= most
        rows.append([name, printed_ah, f"{ours:.4f}", f"{ours / theirs - 1:+.2%}", "yes" if fits else "no"])
    return f"""## Table 5.2: ampere-hours of {table["queries"]} queries

{table["source"]}. Here: `edgevpr.power.equations` with the profile `thesis-xeon` and the printed U_e, U_m,
t_e and t_m. The inputs are printed with two to four digits; the last column says whether the printed Ah_t is possible
with inputs that round to these digits.

{format_markdown_table(("technique", "thesis, Ah", "here, Ah", "difference", "within the printed digits"), rows)}

Equation 5.3 adds the powers of encoding and matching, although one follows the other. Here their energies are added, as
in equation 5.6.
"""


def format_times(results: Results) -> str:
    """Return the section on t_e and t_m: of tables 5.2 and 6.1, section 6.3.2, the author on corridor, and here."""
    published = results.thesis["matrices"]
    power = THESIS["table_5_2"]
    rows = []
    for name, label in ROWS.items():
        row = results.sets["corridor"]["techniques"][label]
        t_encode_s = float(THESIS["table_6_1"]["techniques"][name][-2])
        t_match_s = None
        if name in power["techniques"]:
            t_match_s = float(power["techniques"][name][3]) / power["references"]
        elif name == "CoHOG":
            t_match_s = float(THESIS["cohog"]["t_match_per_ref_s"])
        theirs = published.get(MATRICES.get(name, ""), {})
        encode_ms = [f"{1e3 * t_encode_s:.0f}", format_3g(theirs.get("t_encode_s"), 1e3)]
        encode_ms.append(f"{1e3 * row['t_encode_s']:.1f}")
        here_s = row["t_match_per_ref_s"]
        match_us = [format_3g(time_s, 1e6) for time_s in (t_match_s, theirs.get("t_match_per_ref_s"), here_s)]
        ratios = format_3g(t_encode_s / row["t_encode_s"]), format_3g(t_match_s, 1 / here_s)
        rows.append([name, *encode_ms, ratios[0], *match_us, ratios[1]])
    heads = (
        "technique", "t_e thesis, ms", "author's, corridor", "here", "thesis / here",
        "t_m per reference, thesis, µs", "author's, corridor", "here", "thesis / here",
    )  # fmt: skip
    regions = THESIS["cohog"]["mean_regions"].values()
    count, numbers = THESIS["descriptors"]["CoHOG"]
    products = sum(regions) / len(regions) * count * numbers
    (query,) = (row for row in results.bench["two_stage"] if row["camera"] == "forward")
    cpus = sorted({row["cpu"] for row in select_rows(results, "corridor").values()})
    return f"""## Encoding and matching times

t_e: table 6.1, page 103. t_m: table 5.2, page 87, divided by its {power["references"]} references; for CoHOG, section
6.3.2. *Author's*: the times that he published with his matrices of corridor. Here: corridor, wall time, one thread, on
{" and ".join(cpus)}, with small networks. The thesis used an Intel Xeon Gold 6134 with 32 logical CPUs.

{format_markdown_table(heads, rows)}

CoHOG's t_m of {1e6 * float(THESIS["cohog"]["t_match_per_ref_s"]):.0f} µs is the product of {min(regions)} to
{max(regions)} good regions with {count} regions of {numbers} numbers, {products / 1e6:.0f} million multiplications:
more than one core can do in that time. *cohog* as it flies compares at most 12 places in full, whatever the size of the
map: a query in 10 000 places takes {query["two_stage_ms"]:.0f} ms, including encoding.
"""


def format_pcu(results: Results) -> str:
    """Return the section on figure 6.6: PCU by table 6.1, by the author's matrices, and by the results here."""
    table = THESIS["table_6_1"]
    project = values.compute_pcu(select_rows(results, "corridor"))
    seasons = values.compute_pcu(select_rows(results, "grief_stromovka_seasons"))
    published = values.compute_pcu(results.thesis["matrices"])
    rows = []
    for name in (*table["techniques"], "cohog, as it flies"):
        printed = compute_table_pcu(name) if name in table["techniques"] else [None] * len(table["sets"])
        theirs = published.get(MATRICES.get(name, ""))
        ours = project.get(name)
        difference = None if theirs is None or ours is None else ours - theirs
        cells = map(_format_number, (*printed, theirs, ours))
        rows.append([name, *cells, _format_number(difference, "+.2f"), _format_number(seasons.get(name))])
    heads = ("technique", *table["sets"], "corridor, author's", "corridor, here", "difference", "seasons, here")
    best = []
    names = [name for name in table["techniques"] if not name.startswith("CoHOG")]
    for number, set_name in enumerate(table["sets"]):
        others = {name: compute_table_pcu(name)[number] or 0.0 for name in names}
        rival = max(others, key=lambda name: others[name])
        best.append(f"{set_name} {compute_table_pcu('CoHOG')[number]:.2f} and {others[rival]:.2f} ({rival})")
    leader = max(published, key=lambda name: published[name])
    slowest_ms = [
        1e3 * max(row["t_encode_s"] for row in rows.values())
        for rows in (results.thesis["matrices"], select_rows(results, "corridor"))
    ]
    return f"""## Figure 6.6: PCU

The first five columns are computed from the precisions and encoding times of table 6.1 (page 103; t_e,max
{table["slowest_s"]} s); the figure itself has no numbers. The others are the PCU of the author's matrices and times on
corridor (t_e,max {slowest_ms[0]:.0f} ms), and of the techniques here (t_e,max {slowest_ms[1]:.0f} ms). PCU is relative
to the slowest technique, so between columns only the order can be compared. Here even the slowest network is a small
one, so CoHOG gains little by its speed. *seasons*: grief_stromovka_seasons.

{format_markdown_table(heads, rows)}

CoHOG and the best other technique, on each set of the thesis: {"; ".join(best)}. So the thesis's statement holds that
CoHOG has the best PCU on all five sets. On Cross-Seasons, CoHOG with its best 400 regions has a higher PCU. By the
author's later matrices and times of corridor {leader} has the highest PCU, {published[leader]:.2f}, and CoHOG has
{published["CoHOG"]:.2f}: there, encoding takes {1e3 * results.thesis["matrices"]["CoHOG"]["t_encode_s"]:.0f} ms instead
of {1e3 * float(THESIS["cohog"]["t_encode_s"]):.0f} ms.
"""


def format_memory(results: Results) -> str:
    """Return the section on figures 4.7 and 5.7: the memory of one reference, and of all of Shopping Street."""
    count = THESIS["table_5_2"]["references"]
    rows = []
    for name in ("CoHOG", "Region-VLAD", "Cross-Region-BoW"):
        vectors, numbers = THESIS["descriptors"][name]
        theirs = vectors * numbers * FLOAT_BYTES
        row = results.sets["corridor"]["techniques"][ROWS[name] if name != "CoHOG" else "cohog"]
        ram, disk = row["descriptor_bytes"], row["fine_bytes"]
        sizes = (theirs, theirs * count / 1e6, ram, disk, ram * count / 1e6, theirs / ram)
        rows.append([name, f"{vectors} x {numbers}", *map(format, sizes, ("d", ".0f", "d", "d", ".1f", ".0f"))])
    heads = (
        "technique", "numbers, thesis", "bytes per reference", f"MB of {count}",
        "RAM here, bytes", "disk here, bytes", f"RAM here, MB of {count}", "thesis / RAM here",
    )  # fmt: skip
    return f"""## Figures 4.7 and 5.7: memory of a map

Numbers: {THESIS["descriptors"]["source"]}; each number of the thesis is assumed to take {FLOAT_BYTES} bytes. The bars
of the figures have no numbers. Here CoHOG keeps a place code in RAM, and its regions (8 bits per number) in the map
file; Cross-Region-BoW keeps its words in RAM, and its regions on disk; Region-VLAD uses half precision, and the feature
map of the small network has fewer channels.

{format_markdown_table(heads, rows)}
"""


def compute_map_ratio(results: Results) -> float:
    """Return by which factor a reference of CoHOG is smaller in RAM here than in the thesis."""
    regions, numbers = THESIS["descriptors"]["CoHOG"]
    return regions * numbers * FLOAT_BYTES / results.sets["corridor"]["techniques"]["cohog"]["descriptor_bytes"]


def count_sets_cohog_leads() -> int:
    """Count the sets of table 6.1 on which CoHOG has the best PCU of all techniques."""
    table = THESIS["table_6_1"]
    others = [compute_table_pcu(name) for name in table["techniques"] if not name.startswith("CoHOG")]
    cohog = compute_table_pcu("CoHOG")
    return sum(pcu > max(pcus[number] or 0.0 for pcus in others) for number, pcu in enumerate(cohog))


def _format_number(value: float | None, form: str = ".2f") -> str:
    return "-" if value is None else format(value, form)
