# `make` alone lists what there is. Everything runs in .venv, which `make install` creates.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.lagros-installed
DEMO_STAMP := $(VENV)/.lagros-demo-installed
SPEED_STAMP := $(VENV)/.lagros-speed-installed

# Two test workers, each with one thread: more threads than cores make small matrix products slow.
# No test opens a window.
PYTEST := OMP_NUM_THREADS=1 MPLBACKEND=Agg SDL_VIDEODRIVER=dummy $(BIN)/python -m pytest -n 2
PIP := $(BIN)/python -m pip install -c constraints.txt

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help install demo test test-slow test-other-cpu lint format docs speed clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-14s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

install: $(STAMP) ## create .venv and install lagros with all extras, in the pinned versions

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "lagros needs Python 3.11 or later; name one with: make install PYTHON=..." >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

# The interpreter is an order-only prerequisite: its date says nothing about what is installed.
# torch goes first, so that its build is settled before the packages that depend on it.
# With LOCKED=1 each file is held against its hash first, on Linux with Python 3.11.
$(STAMP): pyproject.toml constraints.txt | $(BIN)/python
ifdef LOCKED
	$(BIN)/python -m pip install --require-hashes -r locked/tests.txt
endif
	$(PIP) torch
	$(PIP) -e ".[all]"
	@touch $@ $(DEMO_STAMP)

# What the demo runs and no more: no torch, no linters, no clusters. `make install` adds the rest.
$(DEMO_STAMP): pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) -e ".[bench]"
	@touch $@

$(SPEED_STAMP): $(STAMP)
	$(PIP) -e ".[speed]"
	@touch $@

demo: $(DEMO_STAMP) ## a short tour: one command, no settings
	$(BIN)/lagros demo

test: lint ## lint, then the tests that are not marked slow
	$(PYTEST) -m "not slow"

test-slow: install ## the tests that are marked slow
	$(PYTEST) -m slow

test-other-cpu: install ## those tests again, as a processor of another make would run them
	settings=$$($(BIN)/python tests/other_cpu.py) && env $$settings $(PYTEST) -m "not slow"

lint: install ## ruff and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: install ## rewrite the code in the project's format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: install ## the site, in site/index.html; ends with an error on any warning
	$(BIN)/python docs/spec.py
	$(BIN)/sphinx-build --quiet --fail-on-warning --keep-going -j 2 docs site

speed: $(SPEED_STAMP) ## micro-benchmarks against peers
	$(BIN)/python benchmarks/speed/run.py

clean: ## remove caches and build products; .venv and runs/ stay
	rm -rf build dist site .mypy_cache .pytest_cache .ruff_cache .hypothesis *.egg-info
	find . -path ./$(VENV) -prune -o -type d -name __pycache__ -exec rm -rf {} +
