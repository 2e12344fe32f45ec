# Two commands do everything on a fresh machine: `make demo` and `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# With the versions that were tested on the environment's Python: 3.11 has constraints.txt, 3.14 those of 3.13.
CONSTRAINTS = $$($(BIN)/python -c "import sys; v = sys.version_info[1]; \
  print('constraints.txt' if v == 11 else f'constraints-3.{min(v, 13)}.txt')")
INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check -c "$(CONSTRAINTS)"

.PHONY: help setup demo test slow faults lint types browser bench docs geomstats clean

help:
	@echo "make demo    set up, then animate three unseen faces into runs/demo"
	@echo "make test    set up, then run the tests"
	@echo "make slow    the slow tests, by hand"
	@echo "make faults  kills, full disks, lost processes and 20,000 damaged files per reader, half an hour"
	@echo "make browser the tests that need Chromium and Node, see docs/contributing.md"
	@echo "make lint    ruff"
	@echo "make types   pyright"
	@echo "make bench   the benchmarks with their peers, a quarter of an hour; BENCH='--quick' and other options"
	@echo "make docs    the documentation as a searchable site, into site/"
	@echo "make clean   remove the virtual environment, the runs and the site"

setup: $(STAMP)

$(STAMP): pyproject.toml $(wildcard constraints*.txt)
	$(PYTHON) -c "import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))" || \
	  { echo "facejax needs Python 3.11 to 3.14; name one with: make PYTHON=python3.12 ..."; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) -e ".[experiments,test]"
	@touch $(STAMP)

demo: setup
	$(BIN)/facejax demo --out runs/demo

test: setup
	$(BIN)/python -m pytest -n 2 -m "not slow"

slow: setup
	$(BIN)/python -m pytest -n 2 -m slow

faults: setup
	@mkdir -p runs && rm -f runs/faults.jsonl
	FACEJAX_FAULT_TRIES=50 FACEJAX_FAULT_FILES=20000 FACEJAX_FAULT_RECORD=$(CURDIR)/runs/faults.jsonl \
	  $(BIN)/python -m pytest -n 2 -m "slow or not slow" tests/faults tests/geometry/test_singular.py tests/mesh/test_singular_meshes.py tests/test_singular_losses.py
	$(BIN)/python tests/faults/table.py runs/faults.jsonl

browser: setup
	$(BIN)/python -m pytest -m browser tests/io tests/viz tests/test_user_study.py

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: setup
	$(INSTALL) -e ".[types]"
	$(BIN)/pyright

bench: setup geomstats
	$(INSTALL) -e ".[bench,experiments]"
	$(BIN)/python -m benchmarks $(BENCH)

docs: setup
	$(INSTALL) -e ".[docs]"
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# It needs an older NumPy than the rest, and so an environment of its own.
geomstats: .venv-geomstats/.installed

.venv-geomstats/.installed:
	$(PYTHON) -m venv .venv-geomstats
	.venv-geomstats/bin/python -m pip install --quiet --disable-pip-version-check "geomstats==2.8.0" "numpy<2.4"
	@touch $@

clean:
	rm -rf $(VENV) .venv-geomstats runs site
