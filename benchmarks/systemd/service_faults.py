"""The faults of the service under a real systemd: `make service-faults` writes benchmarks/results/service_faults.json
and .md, and the table of docs/explanation/faults.md.

python benchmarks/systemd/service_faults.py [--only NAME,NAME] [--report]

As root on a machine with QEMU and debootstrap, which makes a Debian to try the service on. EDGEVPR_MACHINE names the
folder that it is kept in (~/.cache/edgevpr-machine). There is no need of KVM: every instruction is emulated, and
seconds are those of a slow board.
"""

import argparse
import json
import sys
import traceback
from dataclasses import asdict
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).resolve().parents[1]))

import faults_around
import faults_disks
import faults_install
import faults_power
import faults_process
import image
from installed import installed_trial
from page import write_page
from run_sets import made_by
from trial import Row, Trial

GROUPS = (faults_around, faults_process, faults_disks, faults_power, faults_install)
_KEPT = image.REPOSITORY / "benchmarks/results/service_faults.json"
FAULTS = {fault.__name__: fault for group in GROUPS for fault in group.FAULTS}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", metavar="NAME,NAME", default=",".join(FAULTS), help=f"some of {', '.join(FAULTS)}")
    parser.add_argument("--report", action="store_true", help="write the pages of what was measured")
    arguments = parser.parse_args()
    measured = _measured()
    if not arguments.report:
        if problem := image.lacking():
            sys.exit(f"service_faults: {problem}.")
        with installed_trial() as (trial, machine):
            for name in arguments.only.split(","):
                record(name, trial, machine)
        measured = _measured()
    write_page(measured, FAULTS)
    if failed := [name for name, row in measured["faults"].items() if row["failed"]]:
        sys.exit(f"service_faults: not as it should be: {', '.join(failed)}")


def record(name: str, trial: Trial, machine: dict[str, Any]) -> None:
    """Do one fault and keep its row at once: a run that breaks off has lost none."""
    print(f"trying: {name}", flush=True)
    try:
        row = FAULTS[name](trial)
    except Exception as error:  # one that cannot be tried is a row that says so
        traceback.print_exc()
        row = Row(fault=name, failed=[" ".join(str(error).split())[-300:] or type(error).__name__])
        trial.begins_anew()
    print(json.dumps(asdict(row)), flush=True)
    measured = _measured()
    rows = measured["faults"] | {name: asdict(row) | {"made_by": made_by()}}
    kept = {"faults": {each: rows[each] for each in FAULTS if each in rows}, "machine": machine}
    _KEPT.write_text(json.dumps(kept, indent=2) + "\n")


def _measured() -> dict[str, Any]:
    return json.loads(_KEPT.read_text()) if _KEPT.exists() else {"faults": {}}


if __name__ == "__main__":
    main()
