# Everything a newcomer needs; each target sets itself up with Python 3.11+, venv and make alone.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo test lowest lint docs bench bench-peers bench-growth fuzz clean

demo: $(VENV)/base.stamp
	$(BIN)/kalmark demo

test: $(VENV)/test.stamp
	$(BIN)/python -m pytest -n 2 --dist worksteal

# the oldest versions that pyproject.toml allows
lowest: $(VENV)-lowest/stamp
	$(VENV)-lowest/bin/python -m pytest -q tests/test_config.py tests/slam/test_slam.py tests/logs/test_logs_tables.py tests/bags/test_bags_files.py tests/cli/test_cli.py

lint: $(VENV)/test.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python benchmarks/structure.py --check

# the site in build/site, from docs/ and the docstrings; no network but for the packages
docs: $(VENV)/docs.stamp
	$(BIN)/python -m sphinx -W --keep-going -q -d build/doctrees docs build/site

bench: $(VENV)/bench.stamp
	$(BIN)/python benchmarks/step.py

bench-peers: $(VENV)/bench.stamp
	$(BIN)/python benchmarks/peers.py

bench-growth: $(VENV)/base.stamp
	$(BIN)/python benchmarks/map_growth.py

# ten minutes each: every reader, the configuration, the saved map, process; SECONDS=60 for less
SECONDS ?= 600
fuzz: $(VENV)/fuzz.stamp
	$(BIN)/python benchmarks/fuzz.py --seconds $(SECONDS)

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

EXTRAS_test := [dev]
EXTRAS_docs := [docs]
EXTRAS_bench := [peers]
EXTRAS_fuzz := [fuzz]

$(VENV)/%.stamp: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.$(EXTRAS_$*)'
	touch $@

$(VENV)-lowest/stamp: pyproject.toml
	$(PYTHON) -m venv --clear $(VENV)-lowest
	$(VENV)-lowest/bin/python -m pip install --quiet uv
	VIRTUAL_ENV=$(VENV)-lowest $(VENV)-lowest/bin/uv pip install --quiet --resolution lowest-direct -e '.[test]'
	touch $@

clean:
	rm -rf $(VENV) $(VENV)-lowest out build docs/api docs/how docs/lessons docs/project
