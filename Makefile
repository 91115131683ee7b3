# make sil    close the loop over the simulated bus: runs/raster-lockstep-1/ holds recording, summary and picture
# make test   run every test, the linter and the type checker
# make bench  measure what the docs promise and print it
# make docs   draw every figure of docs/ and fill in the generated tables
PYTHON ?= python3
BIN := .venv/bin

.PHONY: sil test bench docs wheel clean

sil: .venv/.ready
	$(BIN)/pkxyz sil

test: .venv/.ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest

bench: .venv/.ready
	$(BIN)/pkxyz bench

docs: .venv/.ready
	$(BIN)/python docs/build.py

wheel: .venv/.ready
	$(BIN)/pip wheel --quiet --no-deps --wheel-dir dist .

# A stamp, so that the environment is built once and again only when what it is built from has changed.
.venv/.ready: pyproject.toml constraints.txt
	@echo "Building the environment in .venv (a minute or two) ..."
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable ".[test]"
	@touch $@

clean:
	rm -rf .venv dist runs
