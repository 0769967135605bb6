"""The faults of the service under a real systemd: `make service-faults` writes benchmarks/results/service_faults.json
and .md, and the table of docs/explanation/faults.md.

python benchmarks/systemd/service_faults.py [--only NAME,NAME] [--report]

As root on a machine with QEMU and debootstrap, which makes a Debian to try the service on. EDGEVPR_MACHINE names the
folder that it is kept in (~/.cache/edgevpr-machine). There is no need of KVM: every instruction is emulated, and
seconds are those of a slow board.
"""

import argparse
import sys
import traceback
from dataclasses import asdict
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[1]))

import base
import faults_board  # noqa: F401  (the order of the imports is that of the faults)
import faults_service  # noqa: F401
import image
from base import REPOSITORY, Row
from installed import installed_trial
from trial import FAULTS, Outcome, Trial

from edgevpr.core.text import markdown

DOCUMENT = REPOSITORY / "docs/explanation/faults.md"
_BEGIN, _END = "<!-- service faults -->\n", "<!-- end -->"
# Taken away at last: it leaves nothing to try.
ORDER = sorted(FAULTS, key=lambda name: (name in ("slow_start", "uninstalled"), name == "uninstalled"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", metavar="NAME,NAME", default=",".join(ORDER), help=f"some of {', '.join(ORDER)}")
    parser.add_argument("--report", action="store_true", help="write the pages of what was measured")
    arguments = parser.parse_args()
    if not arguments.report:
        if problem := image.lacking():
            sys.exit(f"service_faults: {problem}.")
        with installed_trial() as (trial, machine):
            for name in arguments.only.split(","):
                record(name, trial, machine)
    found = base.read("service_faults")
    base.write("service_faults", found, page(found))
    head, rest = DOCUMENT.read_text().split(_BEGIN)
    DOCUMENT.write_text(f"{head}{_BEGIN}\n{_table(found)}\n\n{_END}{rest.split(_END)[1]}")
    if failed := [name for name, row in found["faults"].items() if row["failed"]]:
        sys.exit(f"service_faults: not as it should be: {', '.join(failed)}")


def record(name: str, trial: Trial, machine: Row) -> None:
    """Do one fault and keep its row at once: a run that breaks off has lost none."""
    print(f"trying: {name}", flush=True)
    try:
        outcome = trial.tries(name)
    except Exception as error:  # one that cannot be tried is a row that says so
        traceback.print_exc()
        outcome = Outcome(fault=name, failed=[" ".join(str(error).split())[-300:] or type(error).__name__])
        trial.begins_anew()
    rows = base.read("service_faults").get("faults", {}) | {name: asdict(outcome) | {"made_by": base.made_by()}}
    found = {"faults": {each: rows[each] for each in ORDER if each in rows}, "machine": machine}
    base.write("service_faults", found, page(found))


def page(found: Row) -> str:
    """Return the page for people."""
    made, about = [row["made_by"] for row in found["faults"].values()], found["machine"]
    dates, commits = (", ".join(sorted({each[key] for each in made})) for key in ("date", "commit"))
    return f"""# The service and its faults, under a real systemd

Made by `make service-faults`, {dates}, commit {commits}, {made[-1]["machine"]["cpu"]}.

Machine: {about["inside"]}; processor {about["processor"]}, so that seconds are those of a very slow board. The
installation took {about["installed_s"]} s, a boot {about["boot_s"]:.0f} s.

{_table(found)}
"""


def _table(found: Row) -> str:
    rows = []
    for row in found["faults"].values():
        told = "; ".join(f"`{text}`" for text in row["told"]) or "-"
        again = "-" if row["again_s"] is None else f"{row['again_s']:.0f} s"
        does = row["does"] + "".join(f" **Not so: {what}.**" for what in row["failed"])
        rows.append([row["fault"], does, row["kept"], row["lost"], told, again])
    columns = ["fault", "edgevpr", "kept", "lost", "the ground station is told", "works again after"]
    missing = [name.replace("_", " ") for name in ORDER if name not in found["faults"]]
    return markdown(columns, rows, left=5) + (f"\n\nNot run yet: {', '.join(missing)}." if missing else "")


if __name__ == "__main__":
    base.run(main)
