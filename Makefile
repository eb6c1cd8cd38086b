# export-model: make demo shows it work, make test proves it.
PYTHON ?= $(shell command -v python3.11 || command -v python3.12 || command -v python3.13 || echo python3)
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
JS := converters/runner/js
PYTEST := $(BIN)/python -m pytest

.PHONY: install demo test lint types bench clean help

help:
	@echo "make install   .venv with every extra, and the locked npm packages"
	@echo "make demo      export a fixture to four formats and compare them in every runtime"
	@echo "make test      lint, types and all tests"
	@echo "make bench     speed, memory and size beside what a user would run instead"

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt $(JS)/package-lock.json
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[all,dev]'
	cd $(JS) && npm ci --ignore-scripts --no-audit --no-fund --loglevel=error
	@touch $(STAMP)

demo: install
	$(BIN)/export-model fixtures/recurrent.bytes fixtures/continuous.bytes -o exported --verify auto
	@echo
	@ls -l exported/continuous exported/continuous/saved_model exported/continuous/tfjs

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: install
	$(BIN)/mypy

test: install lint types
	$(PYTEST) -n 2 --dist loadgroup --cov --cov-report=term:skip-covered --cov-fail-under=90

bench: install
	$(BIN)/python -m tests.bench

clean:
	rm -rf $(VENV) exported .pytest_cache .mypy_cache .ruff_cache .hypothesis
