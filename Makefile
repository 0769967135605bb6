# Each target does all of its own set-up: a virtual environment in .venv, made once and again when pyproject.toml changes.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# One thread for the matrix products: what is measured is what one core does, and small products gain nothing from more.
export OPENBLAS_NUM_THREADS ?= 1
# Where this is set, each of the hundreds of processes that the tests start compiles edgevpr anew.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test run-tests test-fast test-benchmarks docs package lint results bench thesis bench-arm64 hostile rig never-worse from-space tilted sites sweeps mutants clean

demo: $(VENV)/installed
	$(BIN)/edgevpr demo --out demo_out

# On two cores, lint and documents beside the tests.
test:
	$(MAKE) --jobs 2 run-tests lint docs

run-tests: $(VENV)/clients/installed $(VENV)/collected.txt
	$(BIN)/python -m pytest -n 4 --dist loadfile --no-loadscope-reorder

# What needs no process, no network and no clock: under a minute.
test-fast: $(VENV)/installed
	$(BIN)/python -m pytest -n 2 -m "not process and not network and not slow and not data"

# What of benchmarks/ needs neither an emulator nor a simulator; not part of `make test`.
test-benchmarks: $(VENV)/installed
	$(BIN)/python -m pytest -n 2 -o pythonpath="benchmarks tests tests/mavlink" benchmarks/tests

# The documents as a site, in site/: every link must lead somewhere.
docs: $(VENV)/installed
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

# A wheel and an sdist that could be published, in dist/.
package: $(VENV)/installed
	rm -rf dist
	$(BIN)/python -m build --outdir dist
	$(BIN)/twine check --strict dist/*

lint: $(VENV)/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/mypy --config-file benchmarks/mypy.ini benchmarks/*.py benchmarks/tests/*.py
	$(BIN)/mypy --config-file benchmarks/mypy.ini benchmarks/rig/*.py benchmarks/arm64/*.py
	$(BIN)/lint-imports --no-cache

# Figures on real image sets (../shared/data, or the folder named in EDGEVPR_DATA) into benchmarks/results/.
results: $(VENV)/installed
	$(BIN)/python benchmarks/run_sets.py
	$(BIN)/python benchmarks/where.py
	$(BIN)/python benchmarks/flights.py
	$(BIN)/python benchmarks/figures_page.py
	$(BIN)/python benchmarks/thesis.py --page

# One map out of many sites, up to ten thousand places, into benchmarks/results/. It goes on in sites_work/ (1 GB) where
# it was interrupted.
sites: $(VENV)/installed
	$(BIN)/python benchmarks/sites.py

# How far an aircraft may be off its map, one change at a time, into benchmarks/results/. It goes on in sweeps_work/.
sweeps: $(VENV)/installed
	$(BIN)/python benchmarks/sweeps.py

# Speed and memory, into benchmarks/results/.
bench: $(VENV)/installed
	$(BIN)/python benchmarks/bench.py
	$(BIN)/python benchmarks/figures_page.py
	$(BIN)/python benchmarks/thesis.py --page

# The tables and figures of the thesis beside this project's, into docs/thesis.md: three minutes of one core. Uses the
# figures of `results` and `bench`, and the sets of EDGEVPR_DATA; for staticity a detector in EDGEVPR_DETECTORS.
thesis: $(VENV)/installed
	$(BIN)/python benchmarks/thesis.py

# What a query costs an ARM core, counted under emulation (as root; Debian's qemu-user, debootstrap and gcc), into
# benchmarks/results/.
bench-arm64: $(VENV)/installed
	$(BIN)/python benchmarks/bench_arm64.py

# Streams, pictures and maps that are damaged or say nothing, from a seed, into benchmarks/results/.
hostile: $(VENV)/installed
	$(BIN)/python benchmarks/hostile.py

# Compiles once what the tests import; otherwise the processes of the first run would each do it.
$(VENV)/collected.txt: $(VENV)/installed
	@$(BIN)/python -m pytest --collect-only -qq > $@ || true

# Ground stations' programs for the tests, without what their windows need (1 GB). Where they cannot be had, their tests
# are skipped.
CLIENTS := MAVProxy==1.8.75 mavsdk==4.1.0
$(VENV)/clients/installed: $(VENV)/made
	@missing=; for each in $(CLIENTS); do \
	    $(BIN)/python -m pip install --quiet --disable-pip-version-check --retries 1 --timeout 20 --upgrade --no-deps \
	        --only-binary :all: --target $(VENV)/clients $$each || { missing=1; echo "$$each: its tests are skipped"; }; \
	done; [ "$$missing" ] || touch $@

# Flights with a real ArduPilot in its own simulator, whose built source EDGEVPR_ARDUPILOT names, into
# benchmarks/results/: two and a half hours.
rig: $(VENV)/installed
	$(BIN)/python benchmarks/rig/rig.py

# Every set-up and event of the sweep beside its control, with a real ArduPilot and PX4 (EDGEVPR_PX4), into
# benchmarks/results/: two to three hours. QUICK=1: the part of ten minutes before a release.
never-worse: $(VENV)/installed
	$(BIN)/python benchmarks/rig/never_worse.py $(if $(QUICK),--quick)

# Maps of a picture from space, flown over on another day, into benchmarks/results/: twenty minutes.
from-space: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[maps]'
	$(BIN)/python benchmarks/from_space.py

# The same flight by cameras that look ahead of straight down, into benchmarks/results/: ten minutes.
tilted: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[maps]'
	$(BIN)/python benchmarks/tilted.py

# Changes of the decisions that keep a wrong position from an aircraft, which their tests must notice, into
# benchmarks/results/: half an hour. It goes on in mutants_work/, where those that were noticed are not made again.
mutants: $(VENV)/installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check cosmic-ray==8.7.0
	$(BIN)/python benchmarks/mutants.py

clean:
	rm -rf $(VENV) demo_out dist build site

$(VENV)/made: pyproject.toml
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(None if (3, 10) <= v < (3, 14) else "edgevpr needs Python 3.10 to 3.13, this is %d.%d: make PYTHON=python3.11" % v)'
	@$(PYTHON) -c 'import struct, sys; sys.exit(None if struct.calcsize("P") == 8 else "edgevpr needs a 64-bit operating system: NumPy, OpenCV and onnxruntime have no wheels for 32 bits")'
	@$(PYTHON) -m venv $(VENV) || { echo "No venv module: install it (Debian, Ubuntu: sudo apt install python3-venv)"; exit 1; }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade pip
	@touch $@

# uv needs a third of the time of pip, which installs everything where there is no uv.
$(VENV)/installed: $(VENV)/made
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check uv \
	    && $(BIN)/uv pip install --quiet --python $(BIN)/python --editable '.[dev]' \
	    || $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --editable '.[dev]'
	@touch $@
