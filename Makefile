# Everything a newcomer needs; each target sets itself up with Python 3.11+, venv and make alone.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin

.PHONY: demo test lint bench bench-peers bench-growth fuzz clean

demo: $(VENV)/base.stamp
	$(BIN)/kalmark demo

test: $(VENV)/test.stamp
	$(BIN)/python -m pytest -n 2

lint: $(VENV)/test.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

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

$(VENV)/base.stamp: pyproject.toml constraints.txt | $(BIN)/python
	$(BIN)/python -m pip install --quiet -c constraints.txt -e .
	touch $@

$(VENV)/test.stamp: $(VENV)/base.stamp
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[dev]'
	touch $@

$(VENV)/bench.stamp: $(VENV)/base.stamp
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[peers]'
	touch $@

$(VENV)/fuzz.stamp: $(VENV)/base.stamp
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[fuzz]'
	touch $@

clean:
	rm -rf $(VENV) out
