# uavrl: `make help` lists the targets. A fresh machine needs Python 3.11 or newer and make.

PYTHON    ?= python3
PIP_FLAGS ?=
JOBS      ?= 2
PYTEST_FLAGS ?=

VENV  := .venv
PY    := $(VENV)/bin/python
STAMP := $(VENV)/.installed

export OMP_NUM_THREADS ?= 1
export MPLBACKEND ?= Agg

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help setup $(VENV) test test-all check format demo clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)
	@echo
	@echo "  Variables: PYTHON=python3.12   the interpreter to build .venv with (3.11 or newer)"
	@echo "             PIP_FLAGS='...'     extra options of pip install, for example an index of CPU builds of torch"
	@echo "             JOBS=2              worker processes of the tests"
	@echo "             PYTEST_FLAGS='...'  extra options of pytest"

setup: $(STAMP)  ## build .venv, with what development needs

$(VENV): $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	  echo "uavrl needs Python 3.11 or newer; '$(PYTHON)' is $$($(PYTHON) --version 2>&1)." >&2; \
	  echo "Name another interpreter: make PYTHON=python3.12 ..." >&2; exit 1; }
	test -x $(PY) || $(PYTHON) -m venv $(VENV)
	$(PY) -m pip install --quiet --constraint constraints.txt $(PIP_FLAGS) --editable '.[dev]'
	@touch $@
