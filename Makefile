# Needs python3 (3.11 or newer) and make; everything else is installed into .venv on first use.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1

.PHONY: install demo test test-core studies test-lowest fuzz quick check bench benchmark numbers docs format wheel clean

demo: $(VENV)/.installed
	$(BIN)/asbuilt demo --out out/demo

# All environments that continuous integration uses.
install: $(VENV)/.installed-check $(VENV)/.installed-docs

test: $(VENV)/.installed-test
	$(BIN)/python tests/make_ready.py
	$(BIN)/python -m pytest -n auto --dist worksteal -m "not study"

# The core alone, in a copy of the tree without any app: what is left of the tests, or CORE_TESTS.
CORE_TESTS ?= tests
test-core: $(VENV)/.installed-test
	$(BIN)/python tests/without_apps.py -n auto -m "not study" $(CORE_TESTS)

# Tests that take seconds each: statistics of many studies, whole recordings of real robots, examples.
studies: $(VENV)/.installed-test
	$(BIN)/python -m pytest -n auto --dist worksteal -m study

QUICK := tests/test_architecture.py tests/test_tables.py tests/test_errors.py tests/description \
	tests/dynamics tests/excitation/motions tests/experiment/logs tests/experiment/signal \
	tests/identification/information tests/writers/tables

# Tests of the foundations, under a minute.
quick: $(VENV)/.installed-test
	$(BIN)/python -m pytest -n auto -m "not slow and not study" $(QUICK)

check: $(VENV)/.installed-check
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# The lowest versions that pyproject.toml allows, of every extra that tests use in one resolution,
# in an environment of their own.
LOWEST := build/lowest
test-lowest: $(VENV)/.installed-check
	$(PYTHON) -m venv $(LOWEST)
	$(LOWEST)/bin/python -m pip install --quiet uv
	$(LOWEST)/bin/uv pip install --quiet --python $(LOWEST)/bin/python --resolution lowest-direct \
		--editable '.[test]'
	$(LOWEST)/bin/python -m pytest -p no:cacheprovider tests/description tests/experiment/logs \
		tests/identification/estimators tests/identification/bodies tests/robustness tests/cli/test_help.py

# Random damage of good files for so many seconds.
SECONDS ?= 60
fuzz: $(VENV)/.installed-test
	$(BIN)/python benchmarks/fuzz.py --seconds $(SECONDS) --out out/fuzz

bench: $(VENV)/.installed-test
	$(BIN)/python benchmarks/run.py --out out/bench.json

# The open benchmark with the tools that are installed, on the data that are at hand, what commands
# print, and the pages that say these numbers.
benchmark: $(VENV)/.installed-test
	$(BIN)/python benchmarks/open/run.py --no-page
	$(BIN)/python benchmarks/open/shown.py --run

# The numbers of this tool alone, after a change of it: its rows and prints, and all pages.
numbers: $(VENV)/.installed-test
	$(BIN)/python benchmarks/open/run.py --tool asbuilt --tool cad --no-page
	$(BIN)/python benchmarks/open/shown.py --run

docs: $(VENV)/.installed-docs
	$(BIN)/python docs/build_pictures.py
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

format: $(VENV)/.installed-check
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Distributions in dist/, checked by installing the wheel alone into an empty environment, where
# the demo then runs without any extra.
wheel: $(VENV)/.installed-check
	rm -rf dist build/wheel
	$(BIN)/python -m build --outdir dist
	$(BIN)/python -m twine check --strict dist/*
	$(BIN)/python -m venv build/wheel
	build/wheel/bin/python -m pip install --quiet dist/*.whl
	cd build && wheel/bin/python -c "import asbuilt, importlib.resources as r; assert (r.files(asbuilt) / 'py.typed').is_file(); [getattr(asbuilt, name) for name in asbuilt.__all__]"
	cd build && wheel/bin/asbuilt demo --out wheel/demo
	test -s build/wheel/demo/report.html

$(BIN)/python:
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "asbuilt needs Python 3.11 or newer, this is " + sys.version.split()[0] + ": make PYTHON=python3.12 ...")'
	$(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); echo "python3 cannot make a virtual environment: install python3-venv"; exit 1; }

$(VENV)/.installed: pyproject.toml | $(BIN)/python
	@echo "Installing asbuilt and what it needs into $(VENV): one or two minutes, once"
	$(BIN)/python -m pip install --editable '.[sim]'
	@touch $@

$(VENV)/.installed-test: pyproject.toml | $(BIN)/python
	@echo "Installing what the tests need into $(VENV): a few minutes, once"
	$(BIN)/python -m pip install --editable '.[test]'
	@touch $@ $(VENV)/.installed

$(VENV)/.installed-check: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable '.[test,check]'
	@touch $@ $(VENV)/.installed $(VENV)/.installed-test

$(VENV)/.installed-docs: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --editable '.[docs]'
	@touch $@ $(VENV)/.installed

clean:
	rm -rf $(VENV) out site .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
