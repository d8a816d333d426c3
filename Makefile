# uavrl: `make help` lists the targets. A fresh machine needs Python 3.11 or newer and make.

PYTHON       ?= python3
PIP_FLAGS    ?=
EXTRAS       ?= dev
JOBS         ?= 2
PYTEST_FLAGS ?=
DEMO_FLAGS   ?=

comma := ,
VENV  := .venv
BIN   := $(VENV)/bin
STAMP := $(VENV)/.installed-$(subst $(comma),-,$(EXTRAS))
DOCUMENTATION := tests/test_documentation.py

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup $(VENV) test test-all check format demo data peers clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-9s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)
	@echo
	@echo "  PYTHON=python3.12    interpreter that builds .venv (3.11 or newer)"
	@echo "  PIP_FLAGS='...'      options of pip install, for example an index with CPU builds of torch"
	@echo "  EXTRAS=dev,export    extras of the package to install"
	@echo "  JOBS=2               worker processes of the tests"
	@echo "  PYTEST_FLAGS='...'   options of pytest, for example -k energy"
	@echo "  DEMO_FLAGS='...'     options of the demonstration"

setup: $(STAMP)  ## build .venv with all that development needs

$(VENV): $(STAMP)

# __init__.py holds the version, which the installed metadata repeats.
$(STAMP): pyproject.toml constraints.txt src/uavrl/__init__.py
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "uavrl needs Python 3.11 or newer; $(PYTHON) is '$$($(PYTHON) --version 2>&1)'." >&2; \
	  echo "Name another interpreter: make PYTHON=python3.12" >&2; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt $(PIP_FLAGS) --editable '.[$(EXTRAS)]'
	@touch $@

# One thread a process: the workers already fill the cores. No display is needed.
test test-all check: export OMP_NUM_THREADS := 1
test test-all check: export MPLBACKEND := Agg

test: $(STAMP)  ## run the tests, slow ones left out
	$(BIN)/python -m pytest -m "not slow" -n $(JOBS) --dist worksteal --ignore $(DOCUMENTATION) $(PYTEST_FLAGS)

test-all: $(STAMP)  ## run every test
	$(BIN)/python -m pytest -n $(JOBS) --dist worksteal --ignore $(DOCUMENTATION) $(PYTEST_FLAGS)

check: $(STAMP)  ## lint, format, types, and the code blocks of the documentation
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy src tests benchmarks $(wildcard examples)
	$(BIN)/python -m pytest --quiet $(DOCUMENTATION)

format: $(STAMP)  ## mend what ruff can mend
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

demo: $(STAMP)  ## learn a small policy from logged flights and watch it
	$(BIN)/python -m uavrl demo $(DEMO_FLAGS)

# The data that the package ships, remade: hours. `good` and `bad` are the last and first third of each training.
data: $(STAMP)  ## collect the built-in data anew, with its good and bad parts, into runs/ (an hour and a half)
	for name in fixed layouts realistic; do \
	  kind=$$([ $$name = fixed ] && echo fixed || echo random); \
	  how=$$([ $$name = realistic ] && echo "--scenario realistic --episodes 150 --set discount=0.97 --set reward.scale=6"); \
	  $(BIN)/uavrl collect --out runs/$$name --layouts $$kind $$how --minari uavrl/$$name-v0 && \
	  for quality in mixed good bad; do \
	    size=$$([ $$quality = mixed ] && echo 50000 || echo 30000); \
	    $(BIN)/uavrl data select runs/$$name/flights.parquet --size $$size --quality $$quality --out runs/$$name-$$quality.parquet || exit 1; \
	  done || exit 1; \
	done
	@echo "to ship them: cp runs/fixed-mixed.parquet src/uavrl/datasets/builtin/fixed.parquet, and the others likewise"

# d3rlpy pins an older gymnasium, so it has an environment of its own; arrays on disk are all that passes between them.
PEERS := .venv-peers
peers: export OMP_NUM_THREADS := 1
peers: $(STAMP) $(PEERS)/.installed  ## cross-check CQL and IQL against d3rlpy, into runs/peers/ (minutes)
	rm -f runs/peers/*.npz
	$(BIN)/python -m benchmarks.peers.ours runs/peers
	$(BIN)/python -m benchmarks.peers.losses_ours runs/peers
	$(PEERS)/bin/python -m benchmarks.peers.losses_theirs runs/peers
	$(PEERS)/bin/python -m benchmarks.peers.theirs runs/peers
	$(BIN)/python -m benchmarks.peers.table runs/peers

$(PEERS)/.installed: benchmarks/peers/constraints.txt
	test -x $(PEERS)/bin/python || $(PYTHON) -m venv $(PEERS)
	$(PEERS)/bin/python -m pip install --quiet --constraint benchmarks/peers/constraints.txt $(PIP_FLAGS) d3rlpy
	@touch $@

clean:  ## remove .venv, .venv-peers, caches and builds
	rm -rf $(VENV) $(PEERS) .mypy_cache .ruff_cache .pytest_cache .hypothesis build dist
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +
