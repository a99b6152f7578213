# Two commands do all the set-up: `make demo` and `make test`. They need git, python3, make and a POSIX shell.

PYTHON ?=            # builds .venv; left empty, the first on the path that is new enough
PYTEST_ARGS ?=       # such as `-n 2`, to run tests in two processes

VENV := .venv
PY := $(VENV)/bin/python
PIP := $(PY) -m pip install --quiet --no-input --disable-pip-version-check
# numba compiles the solver at its first call and keeps what it made: half a minute, once.
COMPILE := $(PY) -c 'import numpy as n, hqp_grasp as h; h.HQP().solve([h.Level.equal(n.eye(2), n.ones(2))])'
# One stamp for each state of $(VENV), so that nothing is installed twice.
MADE := $(VENV)/.made
READY := $(VENV)/.ready
READY_DEV := $(VENV)/.ready-dev
READY_ALL := $(VENV)/.ready-all
READY_BENCH := $(VENV)/.ready-bench
# The oldest dependencies that pyproject.toml admits, with the oldest Python where there is one, in an
# environment of their own. It keeps the compiled solver too: two numbas would overwrite each other's.
OLDEST := .venv-oldest
READY_OLDEST := $(OLDEST)/.ready
BOUNDS := $(PY) -c 'import tomllib; \
  project = tomllib.load(open("pyproject.toml", "rb"))["project"]; \
  needed = project["dependencies"] + project["optional-dependencies"]["test"]; \
  print(*("{}=={}".format(*each.split(">=")) for each in needed), sep="\n")'

unexport PYTHONPATH PYTHONHOME
.DEFAULT_GOAL := help
.PHONY: help demo test test-all test-oldest lint docs bench mutants results clean
.NOTPARALLEL:

help:
	@echo 'make demo    run the cylinder scenario; table on screen, results in out/cylinder'
	@echo 'make test    lint, check types, run the tests, build the docs strictly'
	@echo 'make test-all    the same, then the slow tests, which drive a browser (chromium)'
	@echo 'make test-oldest   run the tests with the oldest dependencies admitted, in .venv-oldest'
	@echo 'make lint    ruff and mypy only'
	@echo 'make docs    build the site into site/'
	@echo 'make bench   compare with peers, print ratios'
	@echo 'make clean   remove what these made, except results in out/'
	@echo 'Each installs what it needs into .venv first; PYTHON=python3.12 chooses the Python.'

demo: $(READY)
	$(PY) scenarios/cylinder.py --out out/cylinder

test: lint $(READY_DEV)
	$(PY) -m pytest $(PYTEST_ARGS)
	$(PY) -m mkdocs build --strict --quiet

test-all: test $(READY_ALL)
	$(PY) -m pytest $(PYTEST_ARGS) -m browser

test-oldest: $(READY_OLDEST)
	NUMBA_CACHE_DIR=$(CURDIR)/$(OLDEST)/numba $(OLDEST)/bin/python -m pytest $(PYTEST_ARGS)

lint: $(READY_DEV)
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy

docs: $(READY_DEV)
	$(PY) -m mkdocs build --strict

bench: $(READY_BENCH)
	@set -e; for file in benchmarks/*.py; do echo "$$file"; $(PY) "$$file"; done

clean:
	rm -rf .venv .venv-oldest build dist site *.egg-info .mypy_cache .pytest_cache .ruff_cache
	find hqp_grasp robots scenarios benchmarks tests -name __pycache__ -prune -exec rm -rf {} +

$(READY): pyproject.toml $(MADE)
	@echo 'Installing hqp_grasp into $(VENV) (once)'
	@$(PIP) --editable '.[view]'
	@$(COMPILE)
	@touch $@

$(READY_DEV): pyproject.toml $(MADE)
	@echo 'Installing hqp_grasp and its tools into $(VENV) (once)'
	@$(PIP) --editable '.[view,test,dev,docs]'
	@$(COMPILE)
	@touch $(READY) $@

$(READY_ALL): pyproject.toml $(MADE)
	@echo 'Installing what drives a browser into $(VENV) (once)'
	@$(PIP) --editable '.[view,test,dev,docs,browser]'
	@touch $(READY) $(READY_DEV) $@

$(READY_OLDEST): pyproject.toml $(MADE)
	@echo 'Installing hqp_grasp and the oldest of all that it needs into $(OLDEST) (once)'
	@python=python3.11; $$python -c 'import ensurepip, venv' 2>/dev/null || python=$(PY); \
	  $$python -m venv --clear $(OLDEST)
	@$(BOUNDS) > $(OLDEST)/bounds.txt
	@$(OLDEST)/bin/python -m pip install --quiet --no-input --disable-pip-version-check \
	  --constraint $(OLDEST)/bounds.txt --editable '.[test]'
	@touch $@

$(READY_BENCH): pyproject.toml $(MADE)
	@echo 'Installing hqp_grasp and its peers into $(VENV) (once)'
	@$(PIP) --editable '.[bench]'
	@$(COMPILE)
	@touch $(READY) $@

# The first Python that is new enough builds $(VENV), or the message says what to install.
$(MADE):
	@new='import sys; sys.exit(sys.version_info < (3, 11))'; \
	found=; \
	for python in $(or $(strip $(PYTHON)),python3 python3.14 python3.13 python3.12 python3.11); do \
	  "$$python" -c "$$new" >/dev/null 2>&1 || continue; \
	  found=$$python; \
	  "$$python" -c 'import ensurepip, venv' >/dev/null 2>&1 || continue; \
	  echo "Making $(VENV) with $$python"; \
	  "$$python" -m venv --clear $(VENV) && touch $@; exit; \
	done; \
	if [ -n "$$found" ]; then \
	  name=$$("$$found" -c 'import sys; print("python%d.%d" % sys.version_info[:2])'); \
	  echo "hqp_grasp needs Python's venv module, which $$found lacks:" \
	    "install the package $$name-venv (Debian, Ubuntu: sudo apt install $$name-venv), then run make again." >&2; \
	else \
	  echo "hqp_grasp needs Python 3.11 or newer, and $(or $(strip $(PYTHON)),python3) is" \
	    "$$($(or $(strip $(PYTHON)),python3) --version 2>/dev/null || echo missing):" \
	    "install Python 3.11 or newer with its venv module (Debian, Ubuntu:" \
	    "sudo apt install python3.11 python3.11-venv; Fedora: sudo dnf install python3.12;" \
	    "macOS: brew install python@3.12), then run make again." >&2; \
	fi; \
	exit 1
