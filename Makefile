# `make` alone lists what there is; every target sets up what it needs.
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help align test bench lint docs schema wheel sdist simulate hub mutants lock clean

PYTHON ?= python3
VENV   ?= .venv
# uv leaves modules to be compiled when they are first imported: unless that is kept,
# each of the thousand processes of the tests compiles all that it imports.
unexport PYTHONDONTWRITEBYTECODE
# OMP_NUM_THREADS would lower what nproc says; it means threads, not processes.
JOBS   ?= $(shell env -u OMP_NUM_THREADS nproc 2>/dev/null || getconf _NPROCESSORS_ONLN)
DATA   ?= manifests/demo.toml
ASSETS ?= 25
SEED   ?= 0
PRESET ?= default
LOCKED ?= yes

NAME      := $(notdir $(basename $(DATA)))
STORE     ?= data/$(NAME).zarr
MANIFESTS ?= manifests/build/$(NAME)
DEMO      := data/demo
BIN       := $(VENV)/bin
SITE      := build/site

help:
	@echo "slatprep: aligned, normalised physics supervision for TRELLIS latents"
	@echo
	@echo "  make align            make demo data, align it, build the store, say how good it is"
	@echo "  make align DATA=FILE  the same on your own data (see manifests/mine.example.toml)"
	@echo "  make test             linters, type checker, documentation, wheel and tests"
	@echo "  make lint             linters and type checker alone"
	@echo "  make bench            every measurement that the documentation quotes, onto docs/benchmarks.md"
	@echo "  make docs             the documentation as a site, in $(SITE)"
	@echo "  make schema           the JSON Schemas of the records, from their classes"
	@echo "  make wheel            a wheel, in dist, tried from another folder"
	@echo "  make sdist            a source archive, in dist, that can run its tests"
	@echo "  make simulate         the tests of the simulation, with its engine (0.5 GB, some minutes)"
	@echo "  make hub              the tests of a published dataset, with the hub's library datasets (0.2 GB)"
	@echo "  make mutants          change one operator or number at a time: do the tests notice?"
	@echo "  make lock             resolve the versions in requirements/ anew"
	@echo "  make clean            remove the environment, the demo data and caches; never your stores"
	@echo
	@echo "Settings, as in 'make align JOBS=4':"
	@echo "  JOBS=$(JOBS)            assets aligned at a time"
	@echo "  PRESET=$(PRESET)     alignment parameters: default, or paper (the protocol of SLAT-Phys)"
	@echo "  ASSETS=$(ASSETS) SEED=$(SEED)  size and seed of the demo data"
	@echo "  PYTHON=$(PYTHON)    Python 3.11 or newer, from which $(VENV) is made"
	@echo "  LOCKED=$(LOCKED)         no: what pyproject.toml allows instead of requirements/*.txt"

# -- what it is for ---------------------------------------------------------

INSTALLED := $(VENV)/.installed$(if $(filter paper,$(PRESET)),-paper)
# A definition that names the hub needs its library.
HUB := $(if $(wildcard $(DATA)),$(shell grep -l '^root *= *"hf://' $(DATA)))

# A file that could not be used fails `make` in the end, but not before the page is drawn.
ifeq ($(DATA),manifests/demo.toml)
align: $(INSTALLED) $(DEMO)/.assets-$(ASSETS)-seed-$(SEED)
else
align: $(INSTALLED) $(if $(HUB),$(VENV)/.installed-hub)
endif
	@status=0; \
	$(BIN)/slatprep build-store --config $(DATA) --out $(STORE) --manifests $(MANIFESTS) \
	    --jobs $(JOBS) $(if $(filter-out default,$(PRESET)),--preset $(PRESET)) || status=$$?; \
	[ $$status -le 1 ] && [ -e $(STORE) ] || exit $$status; \
	$(if $(filter manifests/demo.toml,$(DATA)),$(BIN)/slatprep score $(STORE) $(DEMO)/truth;) \
	$(BIN)/slatprep report $(STORE) --manifests $(MANIFESTS) --out data/$(NAME).html; \
	echo "results: $(STORE) (the store), $(MANIFESTS) (a record of every asset)"; \
	echo "look:    open data/$(NAME).html in a browser"; \
	echo "next:    . $(BIN)/activate && slatprep info $(STORE)"; \
	[ $$status -eq 0 ] || echo "failed:  something did not go in; the build's lines above and $(MANIFESTS) name it"; \
	exit $$status

$(DEMO)/.assets-$(ASSETS)-seed-$(SEED): | $(INSTALLED)
	@new=$(DEMO)-$$$$; trap 'rm -rf '"$$new" EXIT INT TERM; \
	$(BIN)/slatprep make-demo $$new --assets $(ASSETS) --seed $(SEED) --quiet && \
	rm -rf $(DEMO) && mv $$new $(DEMO) && touch $@

# -- development ------------------------------------------------------------

LINT  = $(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/lint-imports && \
        $(BIN)/deptry slatprep && $(BIN)/mypy && \
        $(BIN)/mypy --config-file benchmarks/mypy.ini && $(BIN)/python tools/budget.py && \
        $(BIN)/python tools/prose.py
DOCS  = NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --site-dir $(SITE)
WHEEL = sh tools/try-wheel.sh $(BIN)/python dist

lint: $(VENV)/.installed-dev
	$(LINT)

# A process of tests is one of $(JOBS): a library's threads would wait for each other's cores.
# worksteal leaves no core idle at the end, and tests of one file mostly to one process.
TESTS = $(IN_MEMORY) OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 \
        $(BIN)/python -m pytest -n $(JOBS) --dist worksteal
# Tests write a thousand stores. A disk takes a third of their time, memory none, where it has room.
IN_MEMORY = $(shell df -Pk /dev/shm 2>/dev/null | \
              awk 'END { if ($$4 > 8000000) print "TMPDIR=/dev/shm" }')
# Once, or each process of the tests would compile the same.
KERNELS = $(BIN)/python -c \
          'from slatprep.pipeline.asset import compile_kernels; compile_kernels()'

# Whatever one of them finds, the others run, and the tests' closing line comes last.
# Not by a make within make: such a line would run even under --dry-run.
test: $(VENV)/.installed-dev
	@status=0; log=$$(mktemp); \
	{ $(WHEEL) && $(KERNELS); } >"$$log" 2>&1 & \
	wheel=$$!; \
	{ $(LINT); } || status=1; \
	$(DOCS) || status=1; \
	wait $$wheel || status=1; \
	cat "$$log"; rm "$$log"; \
	$(TESTS) || status=1; \
	exit $$status

docs: $(VENV)/.installed-dev
	$(DOCS)
	@echo "documentation: $(SITE)/index.html"

schema: $(VENV)/.installed-dev
	$(BIN)/python tools/schema.py

wheel: $(VENV)/.installed-dev
	$(WHEEL)

sdist: $(VENV)/.installed-dev
	sh tools/try-sdist.sh $(BIN)/python dist

# Not a part of `make test`: the engine compiles its kernels for a minute or two on a new machine.
simulate: $(VENV)/.installed-dev
	$(BIN)/python -m pip install --quiet --editable '.[simulate,usd]'
	$(BIN)/python -m pytest tests/particles tests/export/test_usd.py

# Not a part of `make test` either: pyarrow would bring the tests' environment above 2.5 GB.
hub: $(VENV)/.installed-dev
	$(BIN)/python -m pip install --quiet datasets
	$(BIN)/python -m pytest tests/export/test_publish.py

# Hours; BENCH=--quick takes minutes, BENCH='--only scale' one of them, BENCH=--list names them.
BENCH ?=
bench: $(VENV)/.installed-dev
	$(BIN)/python benchmarks/bench.py $(BENCH)

# Half an hour of one core; MUTANTS='--budget 300 normalize sample' is a part of it.
MUTANTS ?= --budget 1500 --seed 0
mutants: $(VENV)/.installed-dev
	nice -n 10 $(BIN)/python tools/mutants.py $(MUTANTS)

lock: $(VENV)/.installed-dev
	sh tools/lock.sh $(VENV)

clean:
	rm -rf $(VENV) $(DEMO) data/demo.zarr build dist slatprep.egg-info
	rm -rf .pytest_cache .hypothesis .ruff_cache .mypy_cache .import_linter_cache

# -- environment ------------------------------------------------------------

$(VENV)/.made:
	@sh tools/make-venv.sh $(PYTHON) $(VENV)
	@touch $@

$(VENV)/.installed: pyproject.toml requirements/run.txt tools/install.sh | $(VENV)/.made
	@LOCKED=$(LOCKED) sh tools/install.sh $(VENV) run
	@touch $@

# Open3D is as large as all else, so only the preset that needs it brings it.
$(VENV)/.installed-paper: pyproject.toml requirements/test.txt tools/install.sh | $(VENV)/.made
	@LOCKED=$(LOCKED) sh tools/install.sh $(VENV) paper
	@touch $@ $(VENV)/.installed

$(VENV)/.installed-hub: pyproject.toml requirements/test.txt tools/install.sh | $(INSTALLED)
	@LOCKED=$(LOCKED) sh tools/install.sh $(VENV) hub
	@touch $@

$(VENV)/.installed-dev: pyproject.toml $(wildcard requirements/*.txt) tools/install.sh | $(VENV)/.made
	@LOCKED=$(LOCKED) sh tools/install.sh $(VENV) test
	@touch $@ $(VENV)/.installed $(VENV)/.installed-paper
