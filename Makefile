# Everything in two commands on a machine with Python and git: `make demo` and `make test`.
# The docs site, in site/: `make docs`; its pictures of the demo: `make pictures`.
# While you work: `make check`, which is lint, types and the tests that run no network, in a few minutes.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
WORKERS ?= 2
PYTEST = $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile

# Tests that compile networks take nearly all of the time.
SLOW = parity network method pipeline training calibration learning commands benchmarks pretrained

.PHONY: demo pictures docs test check fast lint format clean

demo: $(VENV)/.runtime
	$(BIN)/vggtjax demo --out demo-output

pictures: demo
	$(BIN)/python docs/pictures/make.py demo-output

docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "open site/index.html"

test: lint
	$(PYTEST) tests/parity
	$(PYTEST) tests --ignore tests/parity --hasty

check: lint fast

fast: $(VENV)/.development
	$(PYTEST) tests --hasty $(SLOW:%=--ignore tests/%)

lint: $(VENV)/.development
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright

format: $(VENV)/.development
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

clean:
	rm -rf $(VENV) build dist site demo-output *.egg-info

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "vggtjax needs Python 3.11 or newer; name one with: make PYTHON=python3.12 ..."; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip

$(VENV)/.runtime: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable .
	touch $@

$(VENV)/.docs: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable '.[docs]'
	touch $@ $(VENV)/.runtime

$(VENV)/.development: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	touch $@ $(VENV)/.runtime $(VENV)/.docs
