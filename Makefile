# Headway. `make` lists what there is; every target sets up the virtual environment first if there is none.

VENV ?= .venv
SUPPORTED = import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))
PYTHON ?= $(shell for each in python3.11 python3.12 python3.13 python3; do \
	$$each -c '$(SUPPORTED)' 2>/dev/null && command -v $$each && break; done)
CONFIG ?= bus_mappo
SEEDS ?= 0..9
ARGS ?=
# For pip: `make setup PIP_ARGS="--extra-index-url https://download.pytorch.org/whl/cpu"` takes torch without CUDA.
PIP_ARGS ?=

STAMP := $(VENV)/.installed
BIN := $(VENV)/bin
# Compiled once for all processes, experiments' and tests'; beside the caches, so that it goes when they go.
COMPILED := envs/headway_envs/__pycache__/.compiled
KERNELS := $(wildcard platform/headway/contracts/numba_setup.py algos/headway_algos/kernels/*.py \
	envs/headway_envs/*.py envs/headway_envs/*/kernel.py envs/headway_envs/*/kernel/*.py)
SOURCES := platform envs algos launch docs tests
# What runs import, a sixth of what is installed: compiled once for all processes. pip would compile everything.
IMPORTED := import codecarbon, hydra, matplotlib.pyplot, mlflow.tracking, pandas, pyarrow.parquet, rich, scipy.stats, supersuit, torch
PIP_INSTALL = $(BIN)/python -m pip install --quiet --no-compile $(PIP_ARGS) -c constraints.txt
WARM_UP := $(BIN)/python -m headway_launch.runner.warm_up
# Side by side, one file of tests in one process, long files first (tests/conftest.py); ARGS="-n 0" tests in this one, where a debugger works.
PYTEST := $(BIN)/python -m pytest --numprocesses=logical --maxprocesses=4 --dist=loadfile --no-loadscope-reorder

.DEFAULT_GOAL := help
.PHONY: help setup experiment sweep test check lint format types robustness benchmarks docs notebooks browse clean
.DELETE_ON_ERROR:

help: ## list the targets
	@echo "make TARGET, where TARGET is one of"
	@awk -F ':.*## ' '/^[a-z]+:.*## /{printf "  %-12s %s\n", $$1, $$2}' Makefile
	@echo 'for example: make experiment CONFIG=bus_mappo ARGS="seed=0..4 algo.lr=3e-4"'

setup: $(COMPILED) ## make the virtual environment .venv, with the versions in constraints.txt, and compile the kernels

$(STAMP): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" && "$(PYTHON)" -c '$(SUPPORTED)' 2>/dev/null || \
		{ echo "make: Python 3.11, 3.12 or 3.13 is needed; give one: make $(or $(MAKECMDGOALS),setup) PYTHON=/path/to/python3.13" >&2; exit 1; }
	@test -x $(BIN)/python || "$(PYTHON)" -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet -c constraints.txt --upgrade pip # Python's own takes twice as long
	@echo "installing packages into $(VENV), once: 3.5 GB, more for torch with CUDA; several minutes"
	@# The kernels need two packages only: they compile on one core while pip installs the rest on another.
	@$(PIP_INSTALL) numba pyyaml
	@$(PIP_INSTALL) --no-deps -e .
	@$(WARM_UP) & $(PIP_INSTALL) -e ".[dev,sumo]"; installed=$$?; echo "compiling kernels"; wait $$! && exit $$installed
	@$(PIP_INSTALL) --no-deps supersuit # where its tinyscaler has no wheel: all but resize_v1 work without
	@touch $@

$(COMPILED): $(STAMP) $(KERNELS)
	@PYTHONDONTWRITEBYTECODE= $(BIN)/python -c "$(IMPORTED)"
	@test ! -e $@ || echo "compiling kernels that have changed"
	@$(WARM_UP)
	@mkdir -p $(@D) && touch $@

experiment: $(COMPILED) ## train one experiment: CONFIG=bus_mappo ARGS="key=value ..."
	@$(BIN)/headway run experiment=$(CONFIG) $(ARGS)

sweep: $(COMPILED) ## train one experiment over many seeds: CONFIG=bus_mappo SEEDS=0..9
	@$(BIN)/headway sweep experiment=$(CONFIG) seed=$(SEEDS) $(ARGS)

# One thread a process: more of them only wait for each other on busy cores.
test check robustness: export OMP_NUM_THREADS = 1
test check robustness: export OPENBLAS_NUM_THREADS = 1
test check robustness: export MKL_NUM_THREADS = 1
# Tests start hundreds of processes, which then read what the first of them compiled.
test check robustness: export PYTHONDONTWRITEBYTECODE =

test: $(COMPILED) ## run the tests that take little time: those without a mark
	@$(PYTEST) -m "not slow and not cluster and not browser and not data" $(ARGS)
	@echo "left out: tests marked slow, cluster, browser or data (pyproject.toml says which); make check runs all"

check: lint types $(COMPILED) ## formatting, lint, types and all tests; those that need Chromium, Slurm or data skip without
	$(PYTEST) -q $(ARGS)

lint: $(STAMP) ## look for mistakes, bad style and formatting
	@$(BIN)/ruff format --check $(SOURCES)
	@$(BIN)/ruff check $(SOURCES)

format: $(STAMP) ## format the code
	@$(BIN)/ruff format $(SOURCES)
	@$(BIN)/ruff check --fix --quiet $(SOURCES)

types: $(STAMP) ## check the types
	@$(BIN)/mypy

robustness: $(COMPILED) ## give faults of many kinds and count how they end: ARGS="--scale hours"
	@$(BIN)/python -m tests.robustness $(ARGS)

benchmarks: $(COMPILED) ## measure the speed of this machine's installation
	@$(BIN)/python -m benchmarks $(ARGS)

docs: $(STAMP) ## build the documentation as a site, docs/_build/index.html; a warning is an error
	@$(BIN)/python -m sphinx -q -E -a -W --keep-going docs docs/_build $(ARGS)
	@echo "open docs/_build/index.html"

# Not of `setup`: Ray's processes would import its rfc3987-syntax, which is slow: python -X importtime -c 'import ray'
notebooks: $(COMPILED) ## install JupyterLab if it is missing and open the notebooks; the first one trains a small study
	@$(PIP_INSTALL) -e ".[notebooks]"
	@$(BIN)/jupyter lab --notebook-dir=notebooks $(ARGS)

browse: $(STAMP) ## serve studies, reports and runs as web pages
	@$(BIN)/headway browse $(ARGS)

clean: ## remove the virtual environment and caches; runs are kept
	rm -rf $(VENV) .mypy_cache .ruff_cache .pytest_cache build dist docs/_build docs/reference
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
