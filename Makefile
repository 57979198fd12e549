# Short names of the long commands. `make demo` and `make test` set up what they need: a virtual environment in
# .venv with the pinned versions of constraints.txt.
.DEFAULT_GOAL := help
VENV ?= .venv
# The first Python >= 3.12 that really runs; override with `make PYTHON=/path/to/python`.
PYTHON ?= $(shell for p in python3.12 python3.13 python3.14 python3; do \
  $$p -c 'import sys; sys.exit(sys.version_info < (3, 12))' >/dev/null 2>&1 && { echo $$p; break; }; done)
RUN = $(VENV)/bin
READY = $(VENV)/.ready
# One thread per process: the simulation is sequential, and the tests run in several processes.
export OMP_NUM_THREADS ?= 1
export NUMBA_NUM_THREADS ?= 1

.PHONY: help demo smoke test test-slow lint docs bench bench-compare clean
help: ## list the targets
	@grep -hE '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 12

$(READY): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "drakerock needs Python >= 3.12, and none was found; set PYTHON=/path/to/python"; exit 1; }
	test -x $(RUN)/python || $(PYTHON) -m venv $(VENV)
	$(RUN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@

demo: $(READY) ## one loading cycle with its replay, into out/demo
	$(RUN)/drakerock load studies/demo.yaml --out out/demo

smoke: $(READY) ## the smallest study, from the first loading to the report, into out/smoke
	$(RUN)/drakerock study run studies/smoke.yaml --out out/smoke
	$(RUN)/drakerock study report out/smoke

test: $(READY) ## the test suite
	$(RUN)/python -m pytest -n auto

test-slow: $(READY) ## the tests that take minutes each
	$(RUN)/python -m pytest -n auto -m slow

lint: $(READY) ## style, types, and the direction of the rooms
	$(RUN)/ruff format --check .
	$(RUN)/ruff check .
	$(RUN)/mypy
	$(RUN)/lint-imports

docs: $(READY) ## the documentation as a site, into out/docs; warnings are errors
	$(RUN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[docs]'
	$(RUN)/python -m sphinx -W --keep-going -q -b html docs out/docs

bench: $(READY) ## the benchmarks
	$(RUN)/python benchmarks/exploration.py speed
	$(RUN)/python benchmarks/pile.py all
	$(RUN)/python benchmarks/rocks.py all

REV ?= HEAD
bench-compare: $(READY) ## CPU time against a git revision, REV=main; kept in benchmarks/history.jsonl
	$(RUN)/python benchmarks/compare_revisions.py $(REV)

clean: ## remove the environment and the results
	rm -rf $(VENV) out
