# Everything runs in .venv, which `make` builds from pyproject.toml and constraints.txt.
# Only Python 3.11 to 3.13 and make need to be there: `make test PYTHON=python3.12`.

PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
TRAIN  := $(VENV)/.train
PYTEST := $(BIN)/python -m pytest
ARGS   ?=
DEMO   ?= demo

# A changed PYTHONPATH or user site would let other packages into the tests.
export PYTHONNOUSERSITE = 1
unexport PYTHONPATH

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help venv demo test test-slow test-train test-all lint lint-format lint-rules lint-types format bench schemas clean

help: ## Show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' Makefile
	@echo "  PYTHON=python3.12 chooses the interpreter; ARGS='-k name' goes to pytest."

venv: $(READY) ## Build or update the environment in .venv

# The example package and the project itself are built with the pinned hatchling of the
# group `dev`, so that nothing unpinned is downloaded to build them.
$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' || { \
	  echo "hdmap-tools needs Python 3.11, 3.12 or 3.13, found: $$($(PYTHON) --version 2>&1)."; \
	  echo "Choose another one: make $(MAKECMDGOALS) PYTHON=python3.12"; exit 1; } >&2
	@# Another interpreter than before: what is in .venv was built for the old one.
	@want="$$($(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])')"; \
	if [ -e $(VENV) ] && ! [ -d "$(VENV)/lib/python$$want/site-packages" ]; then rm -rf $(VENV); fi
	@[ -x $(BIN)/python ] && $(BIN)/python -m pip --version >/dev/null 2>&1 \
	  || $(PYTHON) -m venv --clear $(VENV) || { \
	  echo "$(PYTHON) cannot make a virtual environment (on Debian and Ubuntu: apt-get install python3-venv)." >&2; \
	  rm -rf $(VENV); exit 1; }
	$(BIN)/python -m pip install --quiet --upgrade 'pip>=25.1' # the first that knows --group
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --group dev
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-build-isolation --editable '.[openvino,lidar,distributed]'
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-deps --group av2
	@# av2 lacks dependencies on purpose (see pyproject.toml), nothing else may.
	@! $(BIN)/python -m pip check | grep -v -e '^av2 ' -e '^No broken'
	@touch $@

demo: $(READY) ## Simulate a drive, map it, hold the map against the truth; DEMO=folder
	$(BIN)/hdmap demo -o $(DEMO) --overwrite

test: $(READY) ## Run all tests but the slow ones
	$(PYTEST) $(ARGS)

test-slow: $(READY) ## Run the slow tests only
	$(PYTEST) -m slow $(ARGS)

test-train: $(TRAIN) ## Install torch (5 GB more) and run the tests of training, the slow ones too
	$(PYTEST) -m 'slow or not slow' tests/segmentation/training tests/cli/test_train.py $(ARGS)

# The core must work without torch, so what tests it runs before this.
$(TRAIN): $(READY)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --no-build-isolation --editable '.[openvino,lidar,distributed,train]'
	@touch $@

test-all: $(READY) ## Run all tests, the slow ones too
	$(PYTEST) -m 'not benchmark_suite' $(ARGS)

lint: lint-format lint-rules lint-types ## Check format, lint and types

# Apart, so that `make -k lint` shows the problems of all three.
lint-format: $(READY)
	$(BIN)/ruff format --check --quiet .

lint-rules: $(READY)
	$(BIN)/ruff check .

lint-types: $(READY)
	$(BIN)/mypy

format: $(READY) ## Format the code and repair what ruff can
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: $(READY) ## Run the benchmarks
	$(PYTEST) tests/benchmarks -m benchmark_suite $(ARGS)

schemas: $(READY) ## Generate schemas/ from the typed models
	$(BIN)/python -m hdmap_tools.schemas schemas

clean: ## Remove the environment, caches and built files
	rm -rf $(VENV) build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis .benchmarks
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
