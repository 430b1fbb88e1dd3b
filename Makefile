# Everything runs in a virtual environment of the project's own; `make test` needs nothing but
# Python 3.11 and make.
PYTHON ?= python3
VENV ?= .venv
# Any build will do: TORCH=torch keeps one that is installed in VENV already.
TORCH ?= torch==2.13.0
# Joint steps of `make train`.
STEPS ?= 300000
# Further options of `make tables` and `make report`: TABLES=--quick takes minutes.
TABLES ?=
# Promises and options of `make prove`: PROVE=--quick takes minutes, PROVE="R1 R2" tries two.
PROVE ?=
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help install test check lint type format train enjoy tables report bench prove clean

help: ## list the targets
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

install: $(STAMP) ## set up the virtual environment

$(STAMP): setup.cfg pyproject.toml
	@echo "setting up $(VENV): this takes a minute or two"
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -qq --upgrade pip
	$(BIN)/python -m pip install -qq "$(TORCH)"
	$(BIN)/python -m pip install -qq --editable ".[test,dev,plots,video,tensorboard,vrp,ray,browser]"
	touch $@

test: $(STAMP) ## run the tests
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --maxprocesses 4

train: $(STAMP) ## train HMAPPO on the hard scene, evaluate it, draw one episode
	$(BIN)/python train.py --algo hmappo --env area-search-v0 -n $(STEPS) -f logs -P --verbose 0
	$(BIN)/python enjoy.py --algo hmappo --env area-search-v0 -f logs --video logs/episode.gif

enjoy: $(STAMP) ## play one episode of the latest run in a window
	$(BIN)/python enjoy.py --algo hmappo --env area-search-v0 -f logs

tables: $(STAMP) ## play what is missing, write the paper's tables and figures to results/
	$(BIN)/sb3-roles tables $(TABLES)

report: $(STAMP) ## the same, and results/report.html
	$(BIN)/sb3-roles report $(TABLES)

check: lint type ## run the linters and the type checker

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

type: $(STAMP)
	$(BIN)/mypy

format: $(STAMP) ## rewrite the code in the house format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(STAMP) ## measure the speed of the environment and of training
	$(BIN)/sb3-roles bench

prove: $(STAMP) ## try what is promised about reliability, write results/reliability.md
	mkdir -p results
	$(BIN)/sb3-roles prove $(PROVE) -o results/reliability.md

clean: ## remove the virtual environment and all caches
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
