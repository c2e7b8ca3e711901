# Everything runs in .venv (or F3AMD_VENV), which the first target that needs it builds from requirements.lock.
#   make figures DATA=bandai PROFILE=laptop
#   make test F3AMD_PYTHON=python3.12

DATA ?= synthetic
PROFILE ?= laptop
LAB_OPTIONS ?=
MEASURE ?=
BENCH ?=
PYTEST_OPTIONS ?=

SHELL := /bin/bash
VENV := $(or $(F3AMD_VENV),.venv)
PYTHON := $(VENV)/bin/python
INSTALLED := $(VENV)/installed
NOTEBOOKS := $(sort $(wildcard notebooks/*.ipynb notebooks/course/*.ipynb notebooks/standalone/*.ipynb))
# What a newcomer opens first, for `make test`; the others are for `make test-slow`.
FIRST_NOTEBOOKS := $(sort $(foreach name,00 01 02 03 05 course/01 course/04,$(wildcard notebooks/$(name)_*.ipynb)))

export F3AMD_PYTHON

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help install figures smoke course measure bench bench-tools test test-slow test-long test-all test-extras test-web web-tools \
  lint lab clean site site-tools onnx-tools sweep-tools

help: ## Show this list
	@echo "Targets (first use installs into .venv: some minutes, about 1.4 GB):"
	@awk -F ': .*## ' '/^[a-z-]+:.*## / { printf "  make %-11s %s\n", $$1, $$2 }' Makefile
	@echo "Settings: MEASURE=name of one measurement; DATA=synthetic|bandai|100style|folder  PROFILE=smoke|laptop|gpu"
	@echo "          F3AMD_PYTHON=python3.12   F3AMD_DATA_DIR=folder or zip with the motion data"

$(INSTALLED): requirements.lock pyproject.toml scripts/bootstrap.sh
	@bash scripts/bootstrap.sh

# An extra is installed once, and again where the lock is newer.
$(VENV)/extra-%: $(INSTALLED) scripts/extra.sh
	@bash scripts/extra.sh $*
	@touch $@

install: $(INSTALLED) ## Build .venv and nothing else

figures: $(INSTALLED) ## Run all notebooks, leave results under paper_figures/DATA/PROFILE
	$(PYTHON) -m f3amd_companion figures --data $(DATA) --profile $(PROFILE)

smoke: $(INSTALLED) ## Run all notebooks at their smallest, leave results under runs/DATA/smoke
	$(PYTHON) -m f3amd_companion figures --data $(DATA) --profile smoke

course: $(INSTALLED) ## Run the notebooks of the course on samplers (no data, nothing stored)
	$(PYTHON) -m f3amd_companion course

# Tests run on the CPU, and their results go nowhere near paper_figures/. Notebooks have a process of
# their own: their kernels must not inherit what tests/conftest.py sets, such as another MPLBACKEND.
PYTEST := env -u F3AMD_RESULTS_DIR JAX_PLATFORMS=cpu $(PYTHON) -m pytest --durations=5
# Files side by side on the cores there are; the tests of one file, or the cells of one notebook, in order.
# The plugin for notebooks takes five seconds to load, in each process.
NO_NOTEBOOKS := -p no:nbval
SIDE_BY_SIDE := --numprocesses auto --maxprocesses 4 --dist loadfile
# Test files with a marker: to collect the others as well takes each process ten seconds.
MARKED = $(shell grep -l 'mark\.$(1)\b' tests/test_*.py) -m "$(1)$(2)"
# Notebooks against their committed outputs.
COMPARED = $(PYTEST) $(1) $(SIDE_BY_SIDE) --no-loadscope-reorder --nbval-lax --nbval-current-env \
  --nbval-cell-timeout=600 $(PYTEST_OPTIONS)

measure: $(INSTALLED) ## Measure what notebooks only draw (long; goes on where it stopped)
	F3AMD_RESULTS_DIR=$${F3AMD_RESULTS_DIR:-paper_figures} \
	  $(PYTHON) -m f3amd_companion measure $(MEASURE) --data $(DATA) --profile $(PROFILE)

bench: $(INSTALLED) ## Time synthesis and training on this machine (BENCH=options; bench-tools adds peers)
	F3AMD_RESULTS_DIR=$${F3AMD_RESULTS_DIR:-paper_figures} \
	  $(PYTHON) -m f3amd_companion bench --data $(DATA) --profile $(PROFILE) $(BENCH)

# Optional: benchmarks and tests that need one of these say so and go on without.
bench-tools: $(VENV)/extra-bench ## Add PyTorch, IREE and ONNX Runtime to .venv (about 1 GB more; docs/commands.md)

onnx-tools: $(VENV)/extra-onnx ## Add jax2onnx and ONNX Runtime to .venv (about 150 MB more)

sweep-tools: $(VENV)/extra-sweep ## Add Dask distributed to .venv, for f3amd sweep (about 30 MB)

test: lint ## Lint, run the tests but the slow ones, check committed outputs of the first notebooks
	$(PYTEST) $(NO_NOTEBOOKS) tests $(SIDE_BY_SIDE) -m "not slow and not long" $(PYTEST_OPTIONS)
	$(call COMPARED,$(FIRST_NOTEBOOKS))

# Every preset, whole trainings, several processes: what would make `make test` long.
test-slow: $(INSTALLED) ## Run the slow tests and notebooks that `make test` leaves out
	$(PYTEST) $(NO_NOTEBOOKS) $(SIDE_BY_SIDE) $(call MARKED,slow, and not long) $(PYTEST_OPTIONS)
	$(call COMPARED,$(filter-out $(FIRST_NOTEBOOKS),$(NOTEBOOKS)))

test-long: $(INSTALLED) ## Rehearse all commands of the ledger at smoke size, and the notebooks with another seed
	$(PYTEST) $(NO_NOTEBOOKS) $(SIDE_BY_SIDE) $(call MARKED,long) $(PYTEST_OPTIONS)

test-all: test test-slow test-long test-extras site test-web ## All tests there are, with the site and the browser

# What `make test` and `make test-slow` had to skip in a plain install, and nothing else. A test says what it needs with
# the marker `needs`.
test-extras: bench-tools onnx-tools sweep-tools ## Test what needs PyTorch, IREE, ONNX Runtime or Dask
	$(PYTEST) $(NO_NOTEBOOKS) $(SIDE_BY_SIDE) $(call MARKED,needs) $(PYTEST_OPTIONS)

# The browser is the system's own: as root on Debian it is installed, elsewhere named.
web-tools: $(VENV)/extra-web ## Add selenium to .venv, and Chromium to the system if it is missing
	@bash scripts/browser.sh

test-web: web-tools onnx-tools ## Test the pages in headless Chromium (F3AMD_SCREENSHOTS=folder keeps pictures)
	$(PYTEST) $(NO_NOTEBOOKS) tests/web $(SIDE_BY_SIDE:loadfile=loadgroup) $(PYTEST_OPTIONS)

site-tools: $(VENV)/extra-site ## Add Sphinx, its theme, MathJax and JupyterLite to .venv (about 100 MB)

# From nothing each time, so that no page outlives its source. A warning is an error.
site: site-tools onnx-tools ## Build notebooks, claims, gallery and API as a site: docs/_build/html/index.html
	rm -rf docs/_build
	JAX_PLATFORMS=cpu $(PYTHON) -m sphinx -q -j auto -W --keep-going -c docs -d docs/_build/doctrees \
	  . docs/_build/html
	jobs=; for part in players live lite kit; do JAX_PLATFORMS=cpu $(PYTHON) docs/$$part.py docs/_build/html & jobs+=" $$!"; done; \
	  for job in $$jobs; do wait $$job || exit; done
	$(PYTHON) docs/check_links.py docs/_build/html

lint: $(INSTALLED) ## Check .py and .ipynb files with ruff, and that each import is declared
	$(PYTHON) -m ruff check .
	@$(PYTHON) -m deptry . 2>/dev/null || $(PYTHON) -m deptry .

lab: $(INSTALLED) ## Open the notebook beside the paper in JupyterLab
	$(PYTHON) -m jupyterlab --notebook-dir=. --LabApp.default_url=/lab/tree/notebooks/00_beside_the_paper.ipynb $(LAB_OPTIONS)

clean: ## Remove caches and build leftovers; keeps .venv, data/, runs/, paper_figures/
	rm -rf build dist docs/_build .pytest_cache .ruff_cache ./*.egg-info
	find . \( -path ./.venv -o -path ./$(VENV) -o -path ./.git -o -path ./data -o -path ./runs -o -path ./paper_figures \) \
	  -prune -o -type d \( -name __pycache__ -o -name .pytest_cache \) -exec rm -rf {} +
