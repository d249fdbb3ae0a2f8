PYTHON ?= python3
VENV   ?= .venv
BIN     = $(VENV)/bin
CORES  ?= $(shell nproc 2>/dev/null || echo 2)

.PHONY: thesis test bench datasets setup requirements lint clean

thesis: setup            ## run the whole thesis campaign and print the report's path
	$(BIN)/ehbench reproduce thesis

test: setup              ## pass the tests, in parallel
	$(BIN)/python -m pytest -n $(CORES)

bench: setup             ## measure speed and accuracy, print the table
	$(BIN)/python -m ehbench.benchmark

datasets: setup          ## let the virtual bench record datasets/ again, byte for byte
	$(BIN)/python -m ehbench.datasets

setup: $(VENV)/.ready

$(VENV)/.ready: requirements.txt pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation --no-deps -e .
	touch $@

requirements:            ## pin again (needs uv); hashes only, no addresses
	uv pip compile pyproject.toml --universal --python-version 3.11 --all-extras \
	  --generate-hashes --no-header --no-emit-index-url --no-annotate -q -o requirements.txt

lint: setup
	$(BIN)/ruff check ehbench tests

clean:
	rm -rf $(VENV)
