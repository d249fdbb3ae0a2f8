PYTHON ?= python3
VENV   ?= .venv
BIN     = $(VENV)/bin
CORES  ?= $(shell nproc 2>/dev/null || echo 2)
CODE    = ehbench tests tools
INSTALL = $(BIN)/python -m pip install --quiet --disable-pip-version-check
PIN     = --universal --python-version 3.11 --generate-hashes --no-header --no-emit-index-url \
          --no-annotate -q

# byte code of package and tests is kept, also where the environment says otherwise: to make it
# anew takes each process of the tests several seconds
export PYTHONDONTWRITEBYTECODE =

.PHONY: thesis check test quick coverage fuzz mutate audit format lint types docs reference site wheel bench example study power datasets warm \
        setup dev requirements clean

thesis: setup            ## run the whole thesis campaign and print the report's path
	$(BIN)/ehbench reproduce thesis

check:                   ## all gates, side by side: what must hold before a change goes in
	$(MAKE) -j3 format lint docs types test

test: dev                ## the tests, in parallel
	$(BIN)/python -m pytest -n $(CORES) --dist worksteal

quick: dev               ## the tests but the slow ones, while one works; says how many are left out
	$(BIN)/python -m pytest -n $(CORES) --dist worksteal -m "not slow"

coverage: dev            ## which lines the tests run; bodies of compiled functions are not seen
	$(BIN)/python -m pytest -n $(CORES) --dist worksteal --cov=ehbench --cov-report=term:skip-covered

fuzz: dev                ## 100 000 inputs made wrong on purpose, and what became of them
	$(BIN)/python -m tools.fuzz.fuzzer

mutate: dev              ## whether tests notice wrong code: 300 single changes at random, 30 minutes after a look at which test runs what
	$(INSTALL) cosmic-ray==8.7.0
	$(BIN)/python -m tools.mutate

audit:                   ## whether a pinned dependency has a known weakness; asks a list on the network
	$(PYTHON) -m venv build/audit
	build/audit/bin/python -m pip install --quiet --disable-pip-version-check pip-audit==2.10.1
	build/audit/bin/pip-audit --strict --disable-pip --require-hashes --no-deps -r requirements.txt -r requirements-dev.txt

format: $(VENV)/.dev       ## whether the formatter would change anything
	$(BIN)/ruff format --check $(CODE)

lint: $(VENV)/.dev         ## line length, complexity, arguments, likely mistakes
	$(BIN)/ruff check $(CODE)

types: $(VENV)/.dev        ## types of package, tools and tests
	$(BIN)/pyrefly check --output-format min-text

docs: $(VENV)/.dev         ## whether the key tables in docs/ are those of the models
	$(BIN)/python -m tools.reference --check

reference: dev           ## write these tables anew
	$(BIN)/python -m tools.reference

site: dev                ## docs as pages to browse, offline, in site/
	$(BIN)/mkdocs build --quiet --strict

wheel: $(VENV)/.installed  ## what others install, in dist/
	$(BIN)/python -m pip wheel --quiet --disable-pip-version-check --no-deps --no-build-isolation -w dist .

example: setup           ## the one report that is in git, made again
	rm -rf build/example && $(BIN)/ehbench reproduce press -q --out build/example
	cp build/example/campaign_*/report.html reports/example/report.html

bench: setup             ## measure speed and accuracy, print the table
	$(BIN)/python -m tools.benchmark

study: setup             ## whether 95 % intervals hold the truth, over random rigs; some 20 minutes
	CORES=$(CORES) $(BIN)/python -m tools.coverage_study

power: setup             ## how often a validation passes wrong models, and blames right ones; some 10 minutes
	$(BIN)/python -m tools.power --write

datasets: setup          ## let the virtual bench record datasets/ again, byte for byte
	$(BIN)/python -m tools.datasets

warm: setup              ## compile the kernels again after a change to them
	$(BIN)/python -m ehbench.app.warm

setup: $(VENV)/.ready

$(VENV)/.installed: requirements.txt pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(INSTALL) --require-hashes --no-deps -r requirements.txt
	$(INSTALL) --no-build-isolation --no-deps -e .
	touch $@

$(VENV)/.ready: $(VENV)/.installed
	$(BIN)/python -m ehbench.app.warm
	touch $@

dev: $(VENV)/.ready $(VENV)/.dev  ## what the gates need beside what a run needs

# byte code of what the gates alone need is made as they need it
$(VENV)/.dev: $(VENV)/.installed requirements-dev.txt
	$(INSTALL) --require-hashes --no-deps --no-compile -r requirements-dev.txt
	touch $@

requirements:            ## pin again (needs uv); hashes only, no addresses
	uv pip compile pyproject.toml --extra build $(PIN) -o requirements.txt
	uv pip compile pyproject.toml --all-extras $(PIN) -c requirements.txt -o requirements-dev.txt

clean:                   ## remove the environment and all compiled code
	rm -rf $(VENV)
	find ehbench tests -name __pycache__ -prune -exec rm -rf {} +
