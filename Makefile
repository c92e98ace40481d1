PYTHON ?= python3
PYTEST_ARGS ?= -n 2 --dist loadgroup

BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt
REQUIREMENTS := pyproject.toml constraints.txt

.DEFAULT_GOAL := help
.PHONY: help demo test test-all lint types check docs dist clean

help:
	@echo "make demo      a discovery on bundled recordings"
	@echo "make test      the tests, without the slow ones"
	@echo "make test-all  all tests: also whole searches and notebooks"
	@echo "make lint      ruff"
	@echo "make types     pyright"
	@echo "make check     test, lint and types"
	@echo "make docs      the documentation, in site/"
	@echo "make dist      wheel and sdist, in dist/"
	@echo "make clean     remove the virtual environment and caches"

demo: .venv/.installed
	$(BIN)/jaxid demo

test: .venv/.installed-dev
	$(BIN)/python -m pytest $(PYTEST_ARGS) -m "not slow"

test-all: .venv/.installed-dev
	$(BIN)/python -m pytest $(PYTEST_ARGS)

lint: .venv/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check jaxid tests benchmarks

types: .venv/.installed-dev
	$(BIN)/pyright --pythonpath $(BIN)/python

check: test lint types

docs: .venv/.installed-dev
	$(BIN)/python -m mkdocs build --strict

dist: .venv/.installed-dev
	$(BIN)/python -m hatchling build -d dist

clean:
	rm -rf .venv .pytest_cache .ruff_cache .hypothesis build dist
	find jaxid tests -name __pycache__ -type d -prune -exec rm -rf {} +

.venv/.created:
	$(PYTHON) -m venv .venv
	@touch $@

.venv/.installed: .venv/.created $(REQUIREMENTS)
	@echo "installing jaxid and its dependencies into .venv: a minute or two"
	$(PIP) --editable .
	@touch $@

.venv/.installed-dev: .venv/.created $(REQUIREMENTS)
	$(PIP) --editable '.[dev]'
	@touch $@ .venv/.installed
