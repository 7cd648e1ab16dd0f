# One command a job; `make help` lists them.
SHELL := /bin/bash
.DEFAULT_GOAL := help
.PHONY: help setup setup-dev lint test test-fast test-slow fuzz soak docs demo bench kill clean distclean

BIN := .venv/bin
STAMP := .venv/.setup-complete
DEV_STAMP := .venv/.setup-dev-complete
PYTEST := $(BIN)/python -m pytest
FORMATTED := src tests benchmarks scripts examples
# Dr.Jit compiles on one thread: two processes of tests take little more than half the time of one.
WORKERS ?= 2
KILLS ?= 200
EACH ?= 40
PARALLEL := -n $(WORKERS) --dist worksteal
# Tests of single functions, for the inner loop; what renders or fits is left to `make test`.
FAST := tests/test_backend.py tests/test_config.py tests/test_equations.py tests/test_house.py \
  tests/test_io.py tests/test_public_api.py tests/dataset tests/fields/test_emission.py \
  tests/fields/test_fields.py tests/imaging tests/report tests/scene tests/training/test_schedule.py \
  tests/transport/test_methods.py

help: ## list these jobs
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' Makefile

setup: $(STAMP) ## create .venv with unbake in it and make sure there is an LLVM

$(STAMP): pyproject.toml scripts/setup.sh
	@bash scripts/setup.sh
	@touch $(STAMP)

setup-dev: $(DEV_STAMP) ## setup, and what linters, tests and documentation need

$(DEV_STAMP): $(STAMP)
	@bash scripts/setup.sh dev
	@touch $(DEV_STAMP)

# All checks run even where one fails.
lint: setup-dev ## format, lint, layers and types, without running anything
	@status=0; \
	$(BIN)/ruff format --check --quiet $(FORMATTED) || status=1; \
	$(BIN)/ruff check . || status=1; \
	$(BIN)/lint-imports || status=1; \
	$(BIN)/pyright --pythonpath $(BIN)/python || status=1; \
	exit $$status

# The tests run last, also where a linter fails.
test: setup-dev ## linters and the tests that take seconds
	@status=0; \
	$(MAKE) --no-print-directory lint || status=1; \
	$(PYTEST) $(PARALLEL) -m "not slow and not gpu" $(ARGS) || status=1; \
	exit $$status

test-fast: setup-dev ## tests of single functions, under a minute
	@$(PYTEST) $(PARALLEL) -q -m "not slow and not gpu" $(FAST) $(ARGS)

test-slow: setup-dev ## every test, minutes; those for a GPU run where there is one
	@$(PYTEST) --timeout 1800 $(ARGS)

fuzz: setup-dev ## damage files of every format, N of them (10000): each is read or refused in one line
	@$(BIN)/python benchmarks/fuzz.py --count $(or $(N),10000) $(ARGS)

soak: setup ## a fit of HOURS (2) in one process, watched for memory and files that grow
	@$(BIN)/python benchmarks/soak.py --hours $(or $(HOURS),2) $(ARGS)

docs: setup-dev ## the documentation site, into site/
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

demo: setup ## capture, fit, evaluate and report a small room into demo/ (FRESH=1 starts over)
	@FRESH="$(FRESH)" bash scripts/demo.sh

bench: setup ## where the time of a step goes here, into benchmarks/results (STAIRCASE=data adds it)
	@$(BIN)/python benchmarks/run.py machine --again

kill: setup ## kill a fit at 200 random instants and go on; signals to every command (KILLS, EACH)
	@$(BIN)/python benchmarks/kill.py --kills $(KILLS) --out benchmarks/results/kill.json
	@$(BIN)/python benchmarks/signals.py --each $(EACH) --out benchmarks/results/signals.json

clean: ## remove the demo, builds and caches
	rm -rf demo build dist site src/*.egg-info .hypothesis .pytest_cache .ruff_cache .import_linter_cache
	find src tests scripts -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean ## the same and .venv
	rm -rf .venv
