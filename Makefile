# Two commands do all the set-up: `make demo` and `make test`. They need git, python3, make and a POSIX shell.

PYTHON ?=            # builds .venv; left empty, the first on the path that is new enough
PYTEST_ARGS ?= -n 2  # tests in two processes; left empty, in one
SEED ?= 1            # draws the mutants

VENV := .venv
PY := $(VENV)/bin/python
HQP := $(VENV)/bin/hqp-grasp
PIP := $(PY) -m pip install --quiet --no-input --disable-pip-version-check
# numba compiles the solver at its first call and keeps what it made: half a minute, once.
COMPILE := $(HQP) doctor > /dev/null
# Never --quiet, under which mkdocs counts no warning and so passes a broken link.
SITE := $(PY) -m mkdocs build --strict
# One stamp for each state of $(VENV), so that nothing is installed twice.
MADE := $(VENV)/.made
READY := $(VENV)/.ready
READY_DEV := $(VENV)/.ready-dev
READY_ALL := $(VENV)/.ready-all
READY_BENCH := $(VENV)/.ready-bench
READY_OUTSIDE := $(VENV)/.ready-outside
READY_PACKAGE := $(VENV)/.ready-package
# The oldest dependencies that pyproject.toml admits, with the oldest Python where there is one, in an
# environment of their own. It keeps the compiled solver too: two numbas would overwrite each other's.
OLDEST := .venv-oldest
READY_OLDEST := $(OLDEST)/.ready
BOUNDS := $(PY) -c 'import tomllib; \
  project = tomllib.load(open("pyproject.toml", "rb"))["project"]; \
  needed = project["dependencies"] + project["optional-dependencies"]["test"]; \
  print(*("{}=={}".format(*each.split(">=")) for each in needed), sep="\n")'

unexport PYTHONPATH PYTHONHOME
export NO_MKDOCS_2_WARNING := 1  # mkdocs-material's notice; pyproject.toml holds mkdocs below 2
.DEFAULT_GOAL := help
.PHONY: help demo test test-all test-oldest lint package docs pictures bench outside mutants results clean
.NOTPARALLEL:

help:
	@echo 'make demo    run the cylinder scenario; table on screen, results in out/cylinder'
	@echo 'make test    lint, check types, run the tests, build the docs strictly'
	@echo 'make test-all    the same, then the slow tests, which drive a browser (chromium) and a Dask cluster'
	@echo 'make test-oldest   run the tests with the oldest dependencies admitted, in .venv-oldest'
	@echo 'make lint    ruff and mypy only'
	@echo 'make package   build sdist and wheel into dist/, check them, and grasp with the wheel in an empty environment'
	@echo 'make docs    build the site into site/'
	@echo 'make pictures   draw the laws and the grasp on the front page into docs/ (needs chromium)'
	@echo 'make bench   compare with peers, print ratios'
	@echo 'make outside   grasp with robots, and objects, that nobody here made; 1 GB of packages (an hour)'
	@echo 'make mutants   spoil 60 lines drawn by SEED=1, see whether tests notice (an hour)'
	@echo 'make results   run all that README and docs quote, into out/results, docs/images and docs/data (hours)'
	@echo 'make clean   remove what these made, except results in out/'
	@echo 'Each installs what it needs into .venv first; PYTHON=python3.12 chooses the Python.'

demo: $(READY)
	$(HQP) run cylinder --out out/cylinder

test: lint $(READY_DEV)
	$(PY) -m pytest $(PYTEST_ARGS)
	$(SITE)

test-all: test $(READY_ALL)
	$(PY) -m pytest $(PYTEST_ARGS) -m "browser or cluster"

test-oldest: $(READY_OLDEST)
	NUMBA_CACHE_DIR=$(CURDIR)/$(OLDEST)/numba $(OLDEST)/bin/python -m pytest $(PYTEST_ARGS)

lint: $(READY_DEV)
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m mypy

# Far from this folder, so that nothing of it is imported by chance. The doctor says how long the first
# call took.
package: $(READY_PACKAGE)
	rm -rf build dist *.egg-info
	$(PY) -m build
	$(PY) -m twine check --strict dist/*
	@set -e; away=$$(mktemp -d); trap 'rm -rf "$$away"' EXIT; \
	  $(PY) -m venv "$$away/venv"; \
	  "$$away/venv/bin/python" -m pip install --quiet --no-input --disable-pip-version-check dist/*.whl; \
	  cd "$$away"; unset VIRTUAL_ENV; \
	  venv/bin/hqp-grasp doctor; \
	  venv/bin/hqp-grasp run cylinder --trials 1 --probes 3 --out results; \
	  venv/bin/hqp-grasp robot umass_torso --hand left > /dev/null; \
	  venv/bin/python -m hqp_grasp --version; \
	  echo "in the environment: $$(du -sm venv | cut -f1) MB, of which hqp_grasp $$(du -sk venv/lib/python*/site-packages/hqp_grasp | cut -f1) kB"

docs: $(READY_DEV)
	$(SITE)

pictures: $(READY_ALL)
	$(PY) docs/drawings.py
	$(PY) docs/pictures.py

bench: $(READY_BENCH)
	@set -e; for file in $(filter-out benchmarks/mutants.py benchmarks/grid.py $(wildcard benchmarks/outside_*.py),$(wildcard benchmarks/*.py)); do \
	  echo "$$file"; $(PY) "$$file"; done

outside: $(READY_OUTSIDE)
	$(PY) benchmarks/outside_robots.py
	$(PY) benchmarks/outside_robots.py --only g1 --trials 100 --seed 5150
	$(PY) benchmarks/outside_robots.py --only baxter --trials 100 --seed 5150
	$(PY) benchmarks/outside_objects.py --pictures docs/images
	$(PY) benchmarks/leaning.py --starts 20 --seed 71 --outside

mutants: $(READY_DEV)
	$(PY) benchmarks/mutants.py --seed $(SEED)

# Every command whose figures README.md and docs/ quote. What each prints goes into $(RESULTS), pictures
# into docs/images/, their data into docs/data/. tests/test_packaging.py knows if docs quote a command that is not here.
RESULTS := out/results
keep = $(PY) $(2) > $(RESULTS)/$(1).txt
define judged
$(HQP) run $(1) --trials 100 --probes 20 --seed 83 --out $(RESULTS)/judged-$(1) > $(RESULTS)/judged-$(1).txt
$(HQP) judge $(RESULTS)/judged-$(1) --protocol pulls dexgraspbench >> $(RESULTS)/judged-$(1).txt
$(HQP) judge $(RESULTS)/judged-$(1) --force 10 --mass 0.5 >> $(RESULTS)/judged-$(1).txt
$(HQP) judge $(RESULTS)/judged-$(1) --force 1 --protocol dexgraspbench >> $(RESULTS)/judged-$(1).txt
endef
study = $(HQP) run $(1) --trials 1000 --probes 40 --seed 2026 $(3) --out $(RESULTS)/$(1)$(2) > $(RESULTS)/$(1)$(2).txt

two_arms = $(HQP) run $(1) --hand $(2) --stack $(3) --trials 100 --probes 30 --seed 2027 --out $(RESULTS)/$(1)-$(2) > $(RESULTS)/$(1)-$(2).txt

results: $(READY_BENCH) pictures
	rm -rf $(RESULTS)
	mkdir -p $(RESULTS)
	$(call study,cylinder)
	$(call study,cylinder_65)
	$(call study,hexagon)
	$(call study,irregular)
	$(call study,cylinder,-paper,--form paper)
	$(call study,hexagon,-paper,--form paper)
	$(call study,cylinder,-paper-hierarchy,--form paper-hierarchy)
	$(call study,hexagon,-paper-hierarchy,--form paper-hierarchy)
	$(call study,cylinder,-clipped,--form clipped)
	$(call study,hexagon,-clipped,--form clipped)
	$(call study,cylinder,-memoryless,--form memoryless)
	$(call study,hexagon,-memoryless,--form memoryless)
	$(call study,cylinder,-fm,--stack fm)
	$(call study,cylinder,-pass,--links pass)
	$(call study,cylinder,-eq7,--kinematic-error eq7)
	$(call study,cylinder,-no-landing,--no-landing)
	$(call two_arms,drum,both,fm)
	$(call two_arms,box,both,fm)
	$(call two_arms,drum,palms,fma)
	$(call two_arms,box,palms,fma)
	$(call two_arms,beam,palms,fma)
	$(HQP) report $(RESULTS)/cylinder $(RESULTS)/cylinder-* > $(RESULTS)/report-cylinder.txt
	$(HQP) report $(RESULTS)/hexagon $(RESULTS)/hexagon-* > $(RESULTS)/report-hexagon.txt
	cp $(RESULTS)/cylinder/convergence.png docs/images/cylinder-convergence.png
	$(HQP) run cylinder --probe physical --preset loadcell --out $(RESULTS)/cylinder-physical > $(RESULTS)/cylinder-physical.txt
	for object in cylinder cylinder_65 hexagon irregular; do for cells in "" "--preset loadcell"; do \
	  $(HQP) pick $$object --mass 0.5 $$cells --trials 25 --seed 2027 \
	    --out "$(RESULTS)/pick-$$object$${cells##* }" > "$(RESULTS)/pick-$$object$${cells##* }.txt" || exit 1; \
	done; done
	$(call keep,picks,benchmarks/picks.py --trials 10 --seed 2028)
	$(call keep,figures,benchmarks/figures.py)
	$(call keep,figures-paper,benchmarks/figures.py --form paper)
	$(call keep,damping,benchmarks/damping.py --trials 100 --seed 53)
	$(call keep,compositions,benchmarks/compositions.py --trials 20 --seed 31)
	$(HQP) run cylinder_65 --robot umass_torso --probe physical --preset loadcell --trials 20 --probes 25 --out $(RESULTS)/figure5 > $(RESULTS)/figure5.txt
	$(call keep,forces,benchmarks/forces.py)
	$(call judged,cylinder)
	$(call judged,cylinder_65)
	$(call judged,hexagon)
	$(call judged,irregular)
	$(call keep,judging,benchmarks/judging.py --grasps 12 --seed 73)
	$(call keep,robustness,benchmarks/robustness.py --starts 16 --seed 71 --plot docs/images/robustness.png)
	$(call keep,sensing,benchmarks/sensing.py --plot docs/images/sensing.png)
	$(call keep,physics-figure5,benchmarks/physics.py figure5 --trials 20 --plot docs/images/figure5.png)
	$(call keep,physics-closing,benchmarks/physics.py closing)
	$(call keep,physics-convergence,benchmarks/physics.py convergence --trials 100 --timestep 0.004)
	$(call keep,physics-faults,benchmarks/physics.py faults --trials 100)
	$(call keep,physics-wrong-model,benchmarks/physics.py wrong-model --trials 20)
	$(call keep,physics-speed,benchmarks/physics.py speed)
	$(call keep,prisms,benchmarks/polygons.py --shapes box_6 box_8 box_10 triangle pentagon octagon --starts 80)
	$(call keep,leaning,benchmarks/leaning.py --starts 20 --seed 71)
	$(call keep,noise,benchmarks/noise.py --trials 80 --seed 62)
	$(call keep,polygons,benchmarks/polygons.py --polygons 20 --starts 50 --seed 0)
	$(call keep,caps,benchmarks/caps.py --trials 200 --seed 90)
	$(call keep,probing,benchmarks/probing.py)
	$(call keep,kinematics,benchmarks/kinematics.py)
	$(call keep,damage,benchmarks/damage.py --damages 2000 --seed 20)
	$(call keep,probing-joints,benchmarks/probing.py --robots bhand wam_bhand umass_torso --joints 8 16 24 32 40)
	$(call keep,short-of-joints,benchmarks/short_of_joints.py --configurations 2000 --seed 0)
	$(call keep,tips,benchmarks/tips.py --trials 20 --seed 906)
	$(call keep,limits,benchmarks/limits.py)
	$(call keep,limits-6,benchmarks/limits.py --trials 6)
	$(call keep,equivalence-0,benchmarks/equivalence.py --trials 4 --probes 30)
	$(call keep,equivalence-1,benchmarks/equivalence.py --trials 4 --probes 30 --seed 1)
	$(call keep,near-singular,benchmarks/near_singular.py --plot docs/images/near-singular.png)
	$(call keep,strictness,benchmarks/strictness.py --seed 0)
	$(call keep,starts,benchmarks/starts.py --draws 200 --seed 0)
	$(call keep,edges,benchmarks/edges.py)
	$(call keep,cluster,benchmarks/cluster.py)
	$(call keep,cluster-large,benchmarks/cluster.py --kills 0 --rounds 0 --large 10000)
	$(call keep,cycle,benchmarks/cycle.py)
	$(call keep,where-time-goes,benchmarks/where_time_goes.py --problems 1000)
	$(call keep,solvers,benchmarks/solvers.py)
	$(call keep,solvers-sizes,benchmarks/solvers.py --sizes --problems 150 --checked 2 --plot docs/images/solvers.png)
	$(call keep,fuzz,benchmarks/fuzz.py --problems 100000 --seed 3)
	$(call keep,fuzz-active-set,benchmarks/fuzz.py --problems 20000 --seed 3 --solver active-set)
	$(call keep,fuzz-forces,benchmarks/fuzz.py --kind forces --problems 2000 --seed 4 --solver active-set)
	$(call keep,fuzz-oracle,benchmarks/fuzz.py --kind general --problems 2500 --seed 5 --against-oracle)
	@set -e; for kind in easy mid hard; do for solver in proxqp daqp; do \
	  $(PY) benchmarks/fuzz.py --kind three_level-$$kind --problems 1000 --solver $$solver --against-oracle; \
	done; done > $(RESULTS)/fuzz-three-level.txt

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
	@$(PIP) --editable '.[view,cluster,read,test,dev,docs]'
	@$(COMPILE)
	@touch $(READY) $@

$(READY_ALL): pyproject.toml $(MADE)
	@echo 'Installing what drives a browser into $(VENV) (once)'
	@$(PIP) --editable '.[view,cluster,read,test,dev,docs,browser]'
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
	@$(PIP) --editable '.[bench,cluster]'
	@$(COMPILE)
	@touch $(READY) $@

$(READY_PACKAGE): pyproject.toml $(MADE)
	@echo 'Installing what builds and checks packages into $(VENV) (once)'
	@$(PIP) --editable '.[package]'
	@touch $@

# Only their model files are wanted: none of these packages is imported.
$(READY_OUTSIDE): $(READY)
	@echo 'Installing packages with robots into $(VENV) (once, 300 MB to fetch, 1 GB in place)'
	@$(PIP) --no-deps robosuite==1.5.2 robopianist==1.0.10 example-robot-data==6.0.0
	@touch $@

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
