"""What techniques cost, by the thesis and here: charge, times, memory, PCU. Sections of docs/thesis.md."""

import thesis_values as values
from base import format_markdown_table
from thesis_values import MATRICES, ROWS, THESIS, Results, capitalise, compute_table_pcu, format_3g, select_rows

FLOAT_BYTES = 4


def format_charge() -> str:
    """Table 5.2: the power model on the thesis's own inputs."""
    table = THESIS["table_5_2"]
    rows = []
    for name, (*inputs, printed_ah) in table["techniques"].items():
        ours, least, most = values.bound_formula(values.total_ah, inputs)
        theirs, half = float(printed_ah), values.half_digit(printed_ah)
        fits = least <= theirs + half and theirs - half <= most
        rows.append([name, printed_ah, f"{ours:.4f}", f"{ours / theirs - 1:+.2%}", "yes" if fits else "no"])
    return f"""## Table 5.2: ampere-hours of {table["queries"]} queries

{capitalise(table["source"])}. Here: `edgevpr.power.equations` with the profile `thesis-xeon` on the printed U_e, U_m,
t_e and t_m. The inputs are printed with two to four digits; the last column says whether numbers that are printed so
give the printed Ah_t.

{format_markdown_table(("technique", "thesis, Ah", "here, Ah", "difference", "within the printed digits"), rows)}

Equation 5.3 adds the powers of encoding and matching, which follow one another. Their energies add, as 5.6 has it, and
so it is here.
"""


def format_times(results: Results) -> str:
    """t_e and t_m: tables 5.2 and 6.1, the text of 6.3.2, the author's times on corridor, and those here."""
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
        later = published.get(MATRICES.get(name, ""), {})
        rows.append(
            [name, f"{1e3 * t_encode_s:.0f}", format_3g(later.get("t_encode_s"), 1e3), f"{1e3 * row['t_encode_s']:.1f}"]
        )
        here_s = row["t_match_per_ref_s"]
        matched = [format_3g(time_s, 1e6) for time_s in (t_match_s, later.get("t_match_per_ref_s"), here_s)]
        rows[-1] += [format_3g(t_encode_s / row["t_encode_s"]), *matched, format_3g(t_match_s, 1 / here_s)]
    heads = (
        "technique", "t_e thesis, ms", "author's, corridor", "here", "thesis / here",
        "t_m a reference, thesis, µs", "author's, corridor", "here", "thesis / here",
    )  # fmt: skip
    regions = THESIS["cohog"]["mean_regions"].values()
    many, numbers = THESIS["descriptors"]["CoHOG"]
    products = sum(regions) / len(regions) * many * numbers
    (query,) = (row for row in results.bench["two_stage"] if row["camera"] == "forward")
    cpus = sorted({row["cpu"] for row in select_rows(results, "corridor").values()})
    return f"""## Encoding and matching times

t_e: table 6.1, page 103. t_m: table 5.2, page 87, over its {power["references"]} references; that of CoHOG in section
6.3.2. *Author's*: the times that he published with his matrices of corridor. Here: corridor, wall time, one thread, on
{" and ".join(cpus)}, and for networks small ones. The thesis ran on an Intel Xeon Gold 6134 with 32 logical CPUs.

{format_markdown_table(heads, rows)}

CoHOG's t_m of {1e6 * float(THESIS["cohog"]["t_match_per_ref_s"]):.0f} µs is the product of {min(regions)} to
{max(regions)} good regions with {many} regions of {numbers} numbers, {products / 1e6:.0f} million multiplications: more
than one core does in that time. *cohog* as it flies compares 12 places in full, and no more, whatever the map has:
{query["two_stage_ms"]:.0f} ms for a query of 10 000 places, encoding included.
"""


def format_pcu(results: Results) -> str:
    """Figure 6.6: PCU of table 6.1, of the author's matrices, and of the results here."""
    table = THESIS["table_6_1"]
    here = values.compute_pcu(select_rows(results, "corridor"))
    seasons = values.compute_pcu(select_rows(results, "grief_stromovka_seasons"))
    published = values.compute_pcu(results.thesis["matrices"])
    rows = []
    for name in (*table["techniques"], "cohog, as it flies"):
        printed = compute_table_pcu(name) if name in table["techniques"] else [None] * len(table["sets"])
        theirs = published.get(MATRICES.get(name, ""))
        ours = here.get(name)
        difference = None if theirs is None or ours is None else ours - theirs
        cells = map(_format_number, (*printed, theirs, ours))
        rows.append([name, *cells, _format_number(difference, "+.2f"), _format_number(seasons.get(name))])
    heads = ("technique", *table["sets"], "corridor, author's", "corridor, here", "difference", "seasons, here")
    best = []
    names = [name for name in table["techniques"] if not name.startswith("CoHOG")]
    for number, set_name in enumerate(table["sets"]):
        others = {name: compute_table_pcu(name)[number] or 0.0 for name in names}
        first = max(others, key=lambda name: others[name])
        best.append(f"{set_name} {compute_table_pcu('CoHOG')[number]:.2f} and {others[first]:.2f} ({first})")
    leader = max(published, key=lambda name: published[name])
    slowest_ms = [
        1e3 * max(row["t_encode_s"] for row in rows.values())
        for rows in (results.thesis["matrices"], select_rows(results, "corridor"))
    ]
    return f"""## Figure 6.6: PCU

The first five columns follow from the precisions and encoding times of table 6.1 (page 103; t_e,max
{table["slowest_s"]}
s); the figure itself prints no numbers. Beside them the PCU of the author's matrices and times on corridor (t_e,max
{slowest_ms[0]:.0f} ms), and that of the techniques here (t_e,max {slowest_ms[1]:.0f} ms). PCU is relative to the
slowest technique: across columns only the order tells something. Here even the slowest network is a small one, so that
what CoHOG gains by its speed is small. *seasons*: grief_stromovka_seasons.

{format_markdown_table(heads, rows)}

CoHOG and the best of the other techniques, on each set of the thesis: {"; ".join(best)}. So the thesis's sentence that
CoHOG has the best PCU on all five sets holds. On Cross-Seasons CoHOG's own best 400 regions have more. By the
author's later matrices and times of corridor {leader} has the most, {published[leader]:.2f}, and CoHOG
{published["CoHOG"]:.2f}: it takes {1e3 * results.thesis["matrices"]["CoHOG"]["t_encode_s"]:.0f} ms to encode there, and
not {1e3 * float(THESIS["cohog"]["t_encode_s"]):.0f}.
"""


def format_memory(results: Results) -> str:
    """Figures 4.7 and 5.7: the bytes of a reference, and of all of Shopping Street."""
    count = THESIS["table_5_2"]["references"]
    rows = []
    for name in ("CoHOG", "Region-VLAD", "Cross-Region-BoW"):
        many, numbers = THESIS["descriptors"][name]
        theirs = many * numbers * FLOAT_BYTES
        row = results.sets["corridor"]["techniques"][ROWS[name] if name != "CoHOG" else "cohog"]
        ram, disk = row["descriptor_bytes"], row["fine_bytes"]
        sizes = (theirs, theirs * count / 1e6, ram, disk, ram * count / 1e6, theirs / ram)
        rows.append([name, f"{many} x {numbers}", *map(format, sizes, ("d", ".0f", "d", "d", ".1f", ".0f"))])
    heads = (
        "technique", "numbers, thesis", "bytes a reference", f"MB of {count}",
        "RAM here, bytes", "disk here, bytes", f"RAM here, MB of {count}", "thesis / RAM here",
    )  # fmt: skip
    return f"""## Figures 4.7 and 5.7: memory of a map

Numbers: {THESIS["descriptors"]["source"]}; a number of the thesis is taken for {FLOAT_BYTES} bytes. The bars of the
figures have no numbers. Here CoHOG keeps a place code in RAM and its regions, 8 bits a number, in the map file;
Cross-Region-BoW keeps its words, and its regions on disk; Region-VLAD keeps half precision, and the small network's
map has fewer channels.

{format_markdown_table(heads, rows)}
"""


def compute_map_ratio(results: Results) -> float:
    """Return how many times smaller a reference of CoHOG is in RAM here."""
    many, numbers = THESIS["descriptors"]["CoHOG"]
    return many * numbers * FLOAT_BYTES / results.sets["corridor"]["techniques"]["cohog"]["descriptor_bytes"]


def count_sets_cohog_leads() -> int:
    """Count the sets of table 6.1 on which CoHOG has the best PCU of all techniques."""
    table = THESIS["table_6_1"]
    others = [compute_table_pcu(name) for name in table["techniques"] if not name.startswith("CoHOG")]
    cohog = compute_table_pcu("CoHOG")
    return sum(pcu > max(pcus[number] or 0.0 for pcus in others) for number, pcu in enumerate(cohog))


def _format_number(value: float | None, form: str = ".2f") -> str:
    return "-" if value is None else format(value, form)
