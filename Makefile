# One command a job; `make help` lists them.
SHELL := /bin/bash
.DEFAULT_GOAL := help
.PHONY: help setup test test-slow demo bench clean distclean

BIN := .venv/bin
STAMP := .venv/.setup-complete
PYTEST := $(BIN)/python -m pytest

help: ## list these jobs
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' Makefile

setup: $(STAMP) ## create .venv with unbake in it and make sure there is an LLVM

$(STAMP): pyproject.toml scripts/setup.sh
	@bash scripts/setup.sh
	@touch $(STAMP)

# All checks run even where one fails, the tests last.
test: setup ## linters and the tests that take seconds
	@status=0; \
	$(BIN)/python -m ruff check . || status=1; \
	$(BIN)/lint-imports || status=1; \
	$(PYTEST) -m "not slow and not gpu" $(ARGS) || status=1; \
	exit $$status

test-slow: setup ## every test, minutes; those for a GPU run where there is one
	@$(PYTEST) --timeout 1800 $(ARGS)

demo: setup ## capture, fit, evaluate and report a small room into demo/ (FRESH=1 starts over)
	@FRESH="$(FRESH)" bash scripts/demo.sh

bench: setup ## where the time of a step goes here, into benchmarks/results (STAIRCASE=data adds it)
	@$(BIN)/python benchmarks/run.py machine --again

clean: ## remove the demo, builds and caches
	rm -rf demo build dist src/*.egg-info .pytest_cache .ruff_cache .import_linter_cache
	find src tests scripts -name __pycache__ -type d -prune -exec rm -rf {} +

distclean: clean ## the same and .venv
	rm -rf .venv
