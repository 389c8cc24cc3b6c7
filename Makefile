# Two commands for a fresh machine: `make demo` runs the main job, `make test` the tests.
# Each makes the environment that it needs, from the versions in constraints.txt.
#
#   PYTHON=python3.13   with another Python; its environment lies beside the others
#   VERSIONS=newest     with the newest versions that pip finds, in place of constraints.txt

PYTHON ?= python3
VERSIONS ?= pinned
CONSTRAINTS_pinned := -c constraints.txt
CONSTRAINTS_newest := --upgrade --upgrade-strategy eager
ifeq ($(origin CONSTRAINTS_$(VERSIONS)),undefined)
$(error VERSIONS is `pinned` or `newest`, not `$(VERSIONS)`)
endif

# .venv, or for example .venv-python3.13-newest.
VENV := .venv$(patsubst %,-%,$(filter-out python3,$(notdir $(PYTHON))))$(patsubst %,-%,$(filter-out pinned,$(VERSIONS)))
BIN := $(VENV)/bin
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check $(CONSTRAINTS_$(VERSIONS))
TEST := $(BIN)/python -m pytest -n auto --dist loadfile
AS_ROOT := $(if $(filter 0,$(shell id -u)),,sudo)
# The networks are small: more threads cost more than they bring.
export OMP_NUM_THREADS ?= 1
export MPLBACKEND ?= Agg

# Material for MkDocs advertises its successor at every build.
export NO_MKDOCS_2_WARNING := 1

.PHONY: demo test test-full test-data browser compiler check docs format wheel clean
.PHONY: bench bench-learning bench-paths bench-networks

demo: $(VENV)/.run-time
	$(BIN)/sgvf demo --out demo --overwrite

test: $(VENV)/.development browser compiler
	$(TEST) -m "not benchmark and not full"

# With what takes long: run it before an issue is called done.
test-full: $(VENV)/.development browser compiler
	$(TEST) -m "not benchmark"

# Trains the fields anew that the tests read: for a recipe that has changed on purpose.
test-data: $(VENV)/.development
	$(BIN)/python -m tests.data.make

# The pages of flights are tested in Chromium, which Debian has and PyPI has not.
browser:
	command -v chromium >/dev/null || $(AS_ROOT) sh -c "apt-get update -qq && \
		DEBIAN_FRONTEND=noninteractive apt-get install -y -qq chromium"

# Fields that are exported as C are compiled by the tests.
compiler:
	command -v gcc >/dev/null || $(AS_ROOT) sh -c "apt-get update -qq && \
		DEBIAN_FRONTEND=noninteractive apt-get install -y -qq gcc libc6-dev"

check: $(VENV)/.development
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/mkdocs build --strict --site-dir build/site

# The site with what the notebooks print and draw, which takes some minutes.
docs: $(VENV)/.development
	SGVF_DOCS_EXECUTE=true $(BIN)/mkdocs build --strict

format: $(VENV)/.development
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

# What would be published: sdist and wheel in dist/, checked.  Then the wheel goes into an empty
# environment, where a type checker has to see its types and the README has to run.
TRIAL := build/wheel
wheel:
	rm -rf dist $(TRIAL)
	$(PYTHON) -m venv $(TRIAL)/tools
	$(TRIAL)/tools/bin/python -m pip install --quiet --disable-pip-version-check build cffconvert mypy twine
	$(TRIAL)/tools/bin/cffconvert --validate
	$(TRIAL)/tools/bin/python -m build --outdir dist
	$(TRIAL)/tools/bin/twine check --strict dist/*
	$(PYTHON) -m venv $(TRIAL)/empty
	$(TRIAL)/empty/bin/python -m pip install --quiet --disable-pip-version-check \
		$(CONSTRAINTS_$(VERSIONS)) dist/*.whl
	cd $(TRIAL) && tools/bin/mypy --strict --config-file= --python-executable empty/bin/python \
		$(CURDIR)/tests/distribution/program.py
	$(TRIAL)/empty/bin/python -I tests/distribution/quickstart.py

bench: $(VENV)/.development
	$(BIN)/python -m pytest -m benchmark -s --durations=0

bench-learning: $(VENV)/.development
	$(BIN)/python -m sgvf_drake.experiments.quality --out build/bench-learning --suite full

bench-paths: $(VENV)/.development
	$(BIN)/python -m tests.benchmarks.paths
	$(BIN)/python -m tests.benchmarks.hard_paths

bench-networks: $(VENV)/.development
	$(BIN)/python -m tests.benchmarks.networks

clean:
	rm -rf .venv* demo build site dist *.egg-info .pytest_cache .mypy_cache .ruff_cache

$(VENV)/.run-time: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(INSTALL) -e .
	touch $@

$(VENV)/.development: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(INSTALL) -e ".[dev]"
	touch $(VENV)/.run-time $@
