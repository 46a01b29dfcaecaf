# `make` alone lists what there is; every target sets up what it needs.
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help align test lint clean

PYTHON ?= python3
VENV   ?= .venv
# OMP_NUM_THREADS would lower what nproc says; it means threads, not processes.
JOBS   ?= $(shell env -u OMP_NUM_THREADS nproc 2>/dev/null || getconf _NPROCESSORS_ONLN)
DATA   ?= manifests/demo.toml
ASSETS ?= 25
SEED   ?= 0
PRESET ?= default

NAME      := $(notdir $(basename $(DATA)))
STORE     ?= data/$(NAME).zarr
MANIFESTS ?= manifests/build/$(NAME)
DEMO      := data/demo
BIN       := $(VENV)/bin

help:
	@echo "slatprep: aligned, normalised physics supervision for TRELLIS latents"
	@echo
	@echo "  make align            make demo data, align it, build the store, say how good it is"
	@echo "  make align DATA=FILE  the same on your own data (see manifests/mine.example.toml)"
	@echo "  make test             linter, type checker and tests"
	@echo "  make lint             linter and type checker alone"
	@echo "  make clean            remove the environment, the demo data and caches; never your stores"
	@echo
	@echo "Settings, as in 'make align JOBS=4':"
	@echo "  JOBS=$(JOBS)            assets aligned at a time"
	@echo "  PRESET=$(PRESET)     alignment parameters: default, or paper (the protocol of SLAT-Phys)"
	@echo "  ASSETS=$(ASSETS) SEED=$(SEED)  size and seed of the demo data"
	@echo "  PYTHON=$(PYTHON)    Python 3.11 or newer, from which $(VENV) is made"

# -- what it is for ---------------------------------------------------------

ifeq ($(DATA),manifests/demo.toml)
align: $(VENV)/.installed $(DEMO)/.assets-$(ASSETS)-seed-$(SEED)
else
align: $(VENV)/.installed
endif
	$(BIN)/slatprep build-store --config $(DATA) --out $(STORE) --manifests $(MANIFESTS) \
	    --jobs $(JOBS) $(if $(filter-out default,$(PRESET)),--preset $(PRESET))
ifeq ($(DATA),manifests/demo.toml)
	@$(BIN)/slatprep score $(STORE) $(DEMO)/truth
endif
	@$(BIN)/slatprep report $(STORE) --manifests $(MANIFESTS) --out data/$(NAME).html --quiet
	@echo "results: $(STORE) (the store), $(MANIFESTS) (a record of every asset)"
	@echo "look:    open data/$(NAME).html in a browser"
	@echo "next:    $(BIN)/slatprep info $(STORE)"

$(DEMO)/.assets-$(ASSETS)-seed-$(SEED): | $(VENV)/.installed
	rm -rf $(DEMO)
	$(BIN)/slatprep make-demo $(DEMO) --assets $(ASSETS) --seed $(SEED) --quiet
	@touch $@

# -- development ------------------------------------------------------------

LINT = $(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/mypy

# The tests run whatever the linters say, and their closing line comes last.
test: $(VENV)/.installed-dev
	@status=0; \
	$(LINT) || status=1; \
	$(BIN)/python -m pytest -n $(JOBS) || status=1; \
	exit $$status

lint: $(VENV)/.installed-dev
	$(LINT)

clean:
	rm -rf $(VENV) $(DEMO) data/demo.zarr build slatprep.egg-info
	rm -rf .pytest_cache .hypothesis .ruff_cache .mypy_cache

# -- environment ------------------------------------------------------------

$(VENV)/.made:
	@sh tools/make-venv.sh $(PYTHON) $(VENV)
	@touch $@

$(VENV)/.installed: pyproject.toml | $(VENV)/.made
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --editable .
	@touch $@

# The tests of training run with this one; first, so that nothing pulls in another.
TORCH := torch==2.13.0

$(VENV)/.installed-dev: pyproject.toml | $(VENV)/.made
	$(BIN)/python -m pip install --disable-pip-version-check --quiet $(TORCH)
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --editable '.[dev]'
	@touch $@ $(VENV)/.installed
