# Needs Python 3.11 or newer, and make.
#   make demo   install; take a real CT volume of bone to its parameters and a report
#   make test   install with the test tools; run all tests but the few of make test-long
#   make test-hostile   damaged files, odd options, failing disks: all cases; make test-hostile-quick: some of each kind
#   make lint   ruff and the type checker
#   make docs   the documentation, into site/ (open site/index.html); every warning is an error
# A CPU-only torch, several GB smaller on Linux: make demo TORCH_INDEX=https://download.pytorch.org/whl/cpu

PYTHON ?= python3
TORCH_INDEX ?=

BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check install --quiet --constraint constraints.txt

.PHONY: demo test test-long test-hostile test-hostile-quick lint docs clean

demo: .venv/installed
	@scan=$$($(BIN)/curvafit samples get bone) \
	|| { echo "bone can't be had: taking the synthetic scan"; scan=$$($(BIN)/curvafit samples get synthetic); } \
	&& $(BIN)/curvafit infer "$$scan" -o demo_out

test: .venv/installed-dev
	OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1} $(BIN)/python -m pytest -q -n 2 --dist worksteal -m "not long"

test-long: .venv/installed-dev
	OMP_NUM_THREADS=$${OMP_NUM_THREADS:-1} $(BIN)/python -m pytest -q -n 2 --dist worksteal -m long

test-hostile: .venv/installed-dev
	$(BIN)/python -m tests.hostile

test-hostile-quick: .venv/installed-dev
	$(BIN)/python -m tests.hostile --quick

lint: .venv/installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python

docs: .venv/installed-dev
	NO_MKDOCS_2_WARNING=1 PYTHONWARNINGS=ignore $(BIN)/python -m mkdocs build --strict --quiet

clean:
	rm -rf .venv demo_out build dist site

.venv/installed: EXTRAS :=
.venv/installed-dev: EXTRAS := [dev]
.venv/installed .venv/installed-dev: pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing curvafit$(EXTRAS) into .venv (some minutes the first time)"
	@$(if $(TORCH_INDEX),$(PIP) --index-url $(TORCH_INDEX) --no-deps torch)
	@$(PIP) --editable ".$(EXTRAS)"
	@touch $@

$(BIN)/python:
	@$(PYTHON) -c 'import sys; v = sys.version.split()[0]; sys.exit(None if sys.version_info >= (3, 11) else "expected Python 3.11 or newer, got " + v + "; name another with make PYTHON=...")'
	@$(PYTHON) -m venv .venv || { rm -rf .venv; exit 1; }
