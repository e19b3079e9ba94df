# Needs Python 3.11 or newer, and make.
#   make demo       install; a real CT volume of a shell, filled, measured and read, on one page
#   make test       install with the test tools; every quick test
#   make test-all   every test, the examples too
#   make test-nightly   damaged files and odd options on the command line, many more of them
#   make lint       ruff and the type checker
#   make docs       the documentation, into site/ (open site/index.html); every warning is an error
# A CPU-only torch, several GB smaller on Linux: make demo TORCH_INDEX=https://download.pytorch.org/whl/cpu

PYTHON ?= python3
TORCH_INDEX ?=

BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet --constraint constraints.txt
# Modules stay whole on one worker, so that what they share is made once. Workers with several threads wait for each other.
PYTEST := OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1} NUMBA_NUM_THREADS=$${NUMBA_NUM_THREADS:-1} $(BIN)/python -m pytest -q -n 2 --dist loadscope

.PHONY: demo test test-all test-nightly lint docs clean

demo: .venv/installed
	@$(BIN)/curvafit demo -o demo_out

test: .venv/installed-dev
	$(PYTEST) -m "not slow"

test-all: .venv/installed-dev
	$(PYTEST) --durations=25

test-nightly: .venv/installed-dev
	CURVAFIT_HOSTILE=200 $(PYTEST) tests/hostile

lint: .venv/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

# A page of shapes that grow here is made once. The notebooks run, and become pages with what they show; with EXECUTE= they become pages without it.
EXECUTE ?= --execute
docs: .venv/installed-dev docs/map/atlas.html
	PYTHONWARNINGS=ignore $(BIN)/jupytext --quiet --to ipynb $(EXECUTE) docs/notebooks/*.py
	$(BIN)/jupyter nbconvert --log-level WARN --to markdown docs/notebooks/*.ipynb
	NO_MKDOCS_2_WARNING=1 PYTHONWARNINGS=ignore $(BIN)/python -m mkdocs build --strict --quiet

docs/map/atlas.html: docs/atlas.py | .venv/installed-dev
	PYTHONWARNINGS=ignore $(BIN)/python docs/atlas.py

clean:
	rm -rf .venv demo_out build dist site

.venv/installed: WHAT := --editable ".[infer]"
.venv/installed-dev: WHAT := --editable ".[all]" --group dev
.venv/installed .venv/installed-dev: pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing $(WHAT) into .venv (some minutes the first time)"
	@$(PIP) --upgrade "pip>=25.1"
	@$(if $(TORCH_INDEX),$(PIP) --index-url $(TORCH_INDEX) --no-deps torch)
	@$(PIP) $(WHAT)
	@touch $@

$(BIN)/python:
	@$(PYTHON) -c 'import sys; v = sys.version.split()[0]; sys.exit(None if sys.version_info >= (3, 11) else "needs Python 3.11 or newer, this is " + v + "; name another with make PYTHON=...")'
	@$(PYTHON) -m venv .venv || { rm -rf .venv; exit 1; }
