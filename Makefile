# ConCent-Warp: `make demo` shows it, `make test` checks it. Both set up .venv first, where it is not there yet.

PYTHON ?= $(firstword $(foreach name,python3.11 python3.12 python3.13 python3,$(shell command -v $(name))))
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check -qq
LAYOUT := build/layout/concent_warp
LEROBOT ?= build/lerobot
LEROBOT_PYTHON ?= python3.12
BROWSERS := chromium chromium-browser google-chrome

.PHONY: help demo setup test check lint types imports tests slow lerobot docs format hooks layout system clean
.DEFAULT_GOAL := help

help:
	@echo "make demo     record, fit, events, compare, report: the whole pipeline in Reality, in runs/demo"
	@echo "make test     set up for development and run all checks"
	@echo "make setup    set up for development"
	@echo "make check    run all checks: lint, types, imports, tests"
	@echo "make lint     check format and lint"
	@echo "make types    check types"
	@echo "make imports  check who imports whom"
	@echo "make tests    run the tests, which also build the documentation site and run notebook and examples"
	@echo "make slow     run the tests that take long, which the others leave out"
	@echo "make lerobot  test the plug-ins for lerobot, in an environment of their own, in build/lerobot"
	@echo "make docs     build the documentation site, in build/site"
	@echo "make format   format the code"
	@echo "make hooks    check each commit before it is made"
	@echo "make layout   link the folders together as they are installed, for an editor's type checker"
	@echo "make system   install a Debian package that some tests want (root only)"
	@echo "make clean    remove .venv and what was built"

demo: .venv/installed
	$(BIN)/concent demo --out runs/demo --overwrite

setup: .venv/installed-dev

test: system .venv/installed-dev
	@$(MAKE) --no-print-directory check

# The checks run one after the other, so that the tests come last and their summary ends the output.
check:
	@$(MAKE) --no-print-directory lint
	@$(MAKE) --no-print-directory types
	@$(MAKE) --no-print-directory imports
	@$(MAKE) --no-print-directory tests

lint: .venv/installed-dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .

types: .venv/installed-dev layout
	$(BIN)/pyright --project pyproject.toml

imports: .venv/installed-dev layout
	cd $(dir $(LAYOUT)) && $(CURDIR)/$(BIN)/lint-imports --config $(CURDIR)/pyproject.toml --no-cache

# What is compiled of the sources is kept, also for the processes that tests start. Files run in the order of
# `tests/conftest.py`, the longest first.
tests: .venv/installed-dev
	OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest \
		-n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder

slow: .venv/installed-dev
	OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -m "slow and not gpu" --timeout=900 \
		-n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder

# lerobot wants another Python and another torch than the rest.
lerobot:
	test -x $(LEROBOT)/bin/python || $(LEROBOT_PYTHON) -m venv $(LEROBOT)
	$(LEROBOT)/bin/python -m pip --disable-pip-version-check -qq install "lerobot[dataset,evaluation]~=0.6.1" pytest pytest-timeout \
		--editable . $(foreach name,env policy,--editable plugins/lerobot_$(name)_concent)
	HF_HUB_OFFLINE=1 $(LEROBOT)/bin/python -m pytest tests/plugins

docs: .venv/installed-dev layout
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet --site-dir build/site

format: .venv/installed-dev
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

hooks: .venv/installed-dev
	$(BIN)/pre-commit install

# The top-level folders, linked together as they are installed: for tools that read files and import nothing.
layout:
	@rm -rf $(LAYOUT) && mkdir -p $(LAYOUT)
	@ln -s $(addprefix $(CURDIR)/,$(filter-out %/__pycache__,$(wildcard concent_warp/*)) kernels train render) $(LAYOUT)

system:
	@if [ -n "$(strip $(foreach name,$(BROWSERS),$(shell command -v $(name))))" ]; then :; \
	elif [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null; then \
		{ timeout 60 apt-get update -qq && DEBIAN_FRONTEND=noninteractive timeout 120 \
			apt-get install -qq --no-install-recommends chromium; } </dev/null >/dev/null 2>&1 \
		|| echo "Chromium could not be installed: the tests that open a report in it are skipped."; \
	else echo "There is no Chromium: the tests that open a report in it are skipped."; fi

.venv/bin/python:
	@test -n "$(PYTHON)" || { echo "No Python found: install Python 3.11, or say make PYTHON=..."; exit 1; }
	$(PYTHON) -m venv .venv

.venv/installed: pyproject.toml | .venv/bin/python
	$(PIP) install --editable .
	@touch $@

.venv/installed-dev: .venv/installed
	$(PIP) install --editable ".[dev]"
	@touch $@

clean:
	rm -rf .venv build dist *.egg-info
