"""The faults of the service under a real systemd, on a machine in QEMU: only where EDGEVPR_MACHINE names its folder,
since they take an hour. `make service-faults` does the same, and writes down the figures."""

import os
import sys
from pathlib import Path

import pytest

VARIABLE = "EDGEVPR_MACHINE"
if VARIABLE not in os.environ:
    pytest.skip(f"{VARIABLE} names no folder for the machine that the service is tried on", allow_module_level=True)

sys.path.append(str(Path(__file__).parents[1] / "benchmarks" / "systemd"))
import image  # noqa: E402

if lacking := image.lacking():
    pytest.skip(f"no machine can be made here: {lacking}", allow_module_level=True)

from installed import installed_trial  # noqa: E402
from service_faults import ORDER  # noqa: E402


@pytest.fixture(scope="module")
def trial():
    with installed_trial() as (trial, _):
        yield trial


@pytest.mark.parametrize("name", ORDER)
def test_a_fault_leaves_what_it_should(trial, name):
    outcome = trial.tries(name)
    assert outcome.failed == []
    assert outcome.does
