PYTHON ?= python3
VENV   ?= .venv
BIN     = $(VENV)/bin
CORES  ?= $(shell nproc 2>/dev/null || echo 2)
CODE    = ehbench tests

.PHONY: warm thesis test tests format lint types docs reference bench study datasets setup requirements clean

thesis: setup            ## run the whole thesis campaign and print the report's path
	$(BIN)/ehbench reproduce thesis

test: format lint docs types tests  ## all gates: what must hold before a change goes in

tests: setup             ## the tests alone, in parallel
	$(BIN)/python -m pytest -n $(CORES)

format: setup            ## whether the formatter would change anything
	$(BIN)/ruff format --check $(CODE)

lint: setup              ## line length, complexity, arguments, likely mistakes
	$(BIN)/ruff check $(CODE)

types: setup             ## types of the package
	$(BIN)/basedpyright

docs: setup              ## whether the key tables in docs/ are those of the models
	$(BIN)/python -m ehbench.reference --check

reference: setup         ## write these tables anew
	$(BIN)/python -m ehbench.reference

bench: setup             ## measure speed and accuracy, print the table
	$(BIN)/python -m ehbench.benchmark

study: setup             ## whether 95 % intervals hold the truth, over random rigs; some 20 minutes
	CORES=$(CORES) $(BIN)/python -m ehbench.study

datasets: setup          ## let the virtual bench record datasets/ again, byte for byte
	$(BIN)/python -m ehbench.datasets

warm: setup              ## compile the kernels again after a change to them
	$(BIN)/python -m ehbench.warm

setup: $(VENV)/.ready

$(VENV)/.ready: requirements.txt pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-build-isolation --no-deps -e .
	$(BIN)/python -m ehbench.warm
	touch $@

requirements:            ## pin again (needs uv); hashes only, no addresses
	uv pip compile pyproject.toml --universal --python-version 3.11 --all-extras \
	  --generate-hashes --no-header --no-emit-index-url --no-annotate -q -o requirements.txt

clean:                   ## remove the environment and all compiled code
	rm -rf $(VENV)
	find ehbench tests -name __pycache__ -prune -exec rm -rf {} +
