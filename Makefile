# Two commands for a fresh machine: `make demo` runs the main job, `make test` the tests.
# Each makes the environment it needs in .venv, from the versions in constraints.txt.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALL := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt
AS_ROOT := $(if $(filter 0,$(shell id -u)),,sudo)
# The networks are small: more threads cost more than they bring.
export OMP_NUM_THREADS ?= 1
export MPLBACKEND ?= Agg

# Material for MkDocs advertises its successor at every build.
export NO_MKDOCS_2_WARNING := 1

.PHONY: demo test test-full test-data browser check docs format bench bench-learning clean

demo: $(VENV)/.run-time
	$(BIN)/sgvf demo --out demo --overwrite

test: $(VENV)/.development browser
	$(BIN)/python -m pytest -m "not benchmark and not full" -n auto --dist loadfile

# With what takes long: run it before an issue is called done.
test-full: $(VENV)/.development browser
	$(BIN)/python -m pytest -m "not benchmark" -n auto --dist loadfile

# Trains the fields anew that the tests read: for a recipe that has changed on purpose.
test-data: $(VENV)/.development
	$(BIN)/python -m tests.data.make

# The pages of flights are tested in Chromium, which Debian has and PyPI has not.
browser:
	command -v chromium >/dev/null || $(AS_ROOT) sh -c "apt-get update -qq && \
		DEBIAN_FRONTEND=noninteractive apt-get install -y -qq chromium"

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

bench: $(VENV)/.development
	$(BIN)/python -m pytest -m benchmark -s --durations=0

bench-learning: $(VENV)/.development
	$(BIN)/python -m sgvf_drake.experiments.quality --out build/bench-learning --suite full

clean:
	rm -rf $(VENV) demo build site dist *.egg-info .pytest_cache .mypy_cache .ruff_cache

$(VENV)/.run-time: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(INSTALL) -e .
	touch $@

$(VENV)/.development: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(INSTALL) -e ".[dev]"
	touch $(VENV)/.run-time $@
