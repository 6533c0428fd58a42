# Everything in two commands on a machine with Python and git: `make demo` and `make test`.
# The docs site, in site/: `make docs`; its pictures, of the embedded model: `make pictures`, some two minutes; the
# signatures that the reference shows as plain Markdown: `make reference`.
# The environment of the lock, every file by its hash: `make locked`, before the others. `make lock` makes the lock anew,
# from releases at least a week old; `make audit` and `make sbom` look into it. `make dist` builds the last commit,
# without what is not committed: the same wheel anywhere.
# While you work: `make check`, which is lint and types beside the tests that run few networks, in two minutes.
# `make coverage` counts the lines and branches that the tests run, and `make shuffled` runs them in a random order.
# `make accelerator` compiles for GPUs that are not there and counts (5 GB of NVIDIA's libraries; ARGUMENTS="--top 10"),
# `make accelerator-check` a tiny model in float32, and the memory of a large one, with the compiler alone (0.5 GB), as CI
# does.
# `make gpu-day-wheels` fetches what gpu-day needs beside jax, for a machine that has jax alone and no index.
# `make proofs` runs what takes long and rarely breaks; `make mutants` measures how many faults the tests notice.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
WORKERS ?= 2
TESTS ?= tests
SEED ?= default
SUPPLY := $(VENV)/supply
MUTANTS := $(VENV)/mutants
ACCELERATOR := $(VENV)/accelerator
COMPILERS = $$($(BIN)/python -c 'import jax; print(*(f"jax-cuda12-{part}=={jax.__version__}" for part in ("plugin", "pjrt")))')
ARGUMENTS ?=
FOR_PYTHON ?= 3.12
WHEELS := gpu-day-wheels
COMPILE = $(SUPPLY)/bin/uv pip compile --no-config --quiet --upgrade --exclude-newer '7 days' --generate-hashes \
  --universal --python-version 3.11 --index-url https://pypi.org/simple --no-emit-index-url \
  --custom-compile-command 'make lock'
# Workers share compiled programs in pytest's cache: PYTEST_ADDOPTS=--cache-clear empties it.
PYTEST = $(BIN)/python -m pytest --hasty -n $(WORKERS) --dist worksteal
RANDOM = -p randomly --randomly-seed=$(SEED) --randomly-dont-reset-seed

# Tests that compile networks take nearly all of the time.
SLOW = parity network method pipeline training research interface benchmarks test_docs.py proofs test_packaging.py

# Processes of the tests read compiled Python files rather than compile them anew, whatever the shell says.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: ci demo pictures reference docs test proofs accelerator accelerator-check compiler-is-there gpu-day-wheels mutants check fast coverage shuffled lint format clean locked lock audit sbom dist

# What the repository's checks run, on a clean checkout; programs for GPUs where pip finds their compiler.
ci:
	$(MAKE) demo
	$(MAKE) lint
	$(MAKE) test
	$(MAKE) docs
	if $(MAKE) compiler-is-there; then $(MAKE) accelerator-check; else echo "pip finds no compiler for GPUs"; fi

demo: $(VENV)/.runtime
	$(BIN)/vggtjax demo --out demo-output

pictures: demo $(VENV)/.docs
	$(BIN)/python docs/pictures/make.py demo-output

reference: $(VENV)/.docs
	$(BIN)/python docs/hooks/site.py

docs: $(VENV)/.docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "open site/index.html"

test: $(VENV)/.development
	$(PYTEST) $(TESTS)

# Numbers of the public code once more, with programs that are compiled well: --hasty is left out.
proofs: $(VENV)/.development
	$(PYTEST) $(TESTS) -m proof --ignore tests/parity
	$(if $(filter tests,$(TESTS)),$(BIN)/python -m pytest -n $(WORKERS) tests/parity -m "")

# In folders of their own: where the compilers are, every program is traced for GPUs too.
accelerator: $(ACCELERATOR)/.whole
	JAX_PLATFORMS=cpu $(ACCELERATOR)/whole/bin/python -m benchmarks accelerator $(ARGUMENTS)

accelerator-check: $(ACCELERATOR)/.compiler
	JAX_PLATFORMS=cpu PYTHONPATH=$(ACCELERATOR)/compiler $(BIN)/python -m benchmarks accelerator --size tiny --frames 4 \
	  --targets h100 l4 --dtype float32 --precision highest \
	  --programs "image features" "first pass" "dynamic mask" "second pass" assemble attention
	JAX_PLATFORMS=cpu PYTHONPATH=$(ACCELERATOR)/compiler $(BIN)/python -m benchmarks accelerator --frames 200 \
	  --programs "first pass" --most 8

compiler-is-there: $(VENV)/.development
	$(BIN)/python -m pip download --quiet --no-deps --dest $(ACCELERATOR)/wheels $(COMPILERS)

gpu-day-wheels: $(SUPPLY)/.installed
	rm -rf $(WHEELS)
	$(SUPPLY)/bin/python benchmarks/gpu_day/wheels.py $(FOR_PYTHON) $(WHEELS)

$(ACCELERATOR)/.whole: pyproject.toml
	$(PYTHON) -m venv $(ACCELERATOR)/whole
	$(ACCELERATOR)/whole/bin/python -m pip install --quiet --editable '.[accelerator,train]'
	touch $@

$(ACCELERATOR)/.compiler: $(VENV)/.development
	rm -rf $(ACCELERATOR)/compiler
	mkdir -p $(ACCELERATOR)
	$(BIN)/python -m pip install --quiet --no-deps --target $(ACCELERATOR)/compiler $(COMPILERS)
	touch $@

mutants: $(VENV)/.development $(MUTANTS)/.installed
	rm -rf build/mutants
	git clone --quiet . build/mutants
	PATH="$(abspath $(BIN)):$(abspath $(MUTANTS)/bin):$$PATH" MODULES="$(MODULES)" build/mutants/tests/proofs/mutants/run.sh

check: $(VENV)/.development
	$(MAKE) --jobs 2 lint fast

fast: $(VENV)/.development
	$(PYTEST) -q tests $(SLOW:%=--ignore tests/%)

coverage: $(VENV)/.coverage
	$(PYTEST) --cov --cov-report=term:skip-covered $(TESTS)

shuffled: $(VENV)/.coverage
	$(PYTEST) $(RANDOM) $(TESTS)

lint: $(VENV)/.development
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright

format: $(VENV)/.development
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

locked: | $(BIN)/python
	$(BIN)/python -m pip install --quiet --require-hashes --requirement requirements/dev.lock
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	touch $(VENV)/.runtime $(VENV)/.docs $(VENV)/.development

lock: $(SUPPLY)/.installed
	$(COMPILE) --extra dev pyproject.toml --output-file requirements/dev.lock
	$(COMPILE) --group supply --output-file requirements/supply.lock
	$(COMPILE) --group coverage --no-deps --output-file requirements/coverage.lock

audit: $(SUPPLY)/.installed
	$(SUPPLY)/bin/pip-audit --strict --disable-pip --require-hashes --progress-spinner off \
	  --requirement requirements/dev.lock --requirement requirements/supply.lock \
	  --requirement requirements/coverage.lock

sbom: $(SUPPLY)/.installed
	$(SUPPLY)/bin/cyclonedx-py requirements requirements/dev.lock --pyproject pyproject.toml --output-reproducible \
	  --output-file sbom.json
	@echo "wrote sbom.json, in CycloneDX's format"

dist: $(SUPPLY)/.installed
	rm -rf build dist
	mkdir -p build/source
	git -c tar.umask=022 archive HEAD | (umask 022 && tar -xf - -C build/source)
	umask 022 && SOURCE_DATE_EPOCH=$$(git log -1 --format=%ct) \
	  $(SUPPLY)/bin/python -m build --no-isolation --outdir dist build/source
	rm -rf build

clean:
	rm -rf $(VENV) build dist site demo-output $(WHEELS) sbom.json *.egg-info

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
	$(BIN)/python -m pip install --quiet --no-compile --editable '.[dev]'
	touch $@ $(VENV)/.runtime $(VENV)/.docs

$(VENV)/.coverage: requirements/coverage.lock | $(VENV)/.development
	$(BIN)/python -m pip install --quiet --no-deps --require-hashes --requirement requirements/coverage.lock
	touch $@

$(SUPPLY)/.installed: requirements/supply.lock
	$(PYTHON) -m venv $(SUPPLY)
	$(SUPPLY)/bin/python -m pip install --quiet --require-hashes --requirement requirements/supply.lock
	touch $@

$(MUTANTS)/.installed:
	$(PYTHON) -m venv $(MUTANTS)
	$(MUTANTS)/bin/python -m pip install --quiet 'cosmic-ray>=8.3'
	touch $@
