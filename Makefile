# `make fly` installs what flies and flies the virtual Crazyflie; `make test` installs what tests and runs the tests.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --disable-pip-version-check --editable

.PHONY: install fly test slow fuzz lint clean

install: $(VENV)/installed

$(VENV)/installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(PIP) .
	$(BIN)/cfplan doctor --warm-up
	touch $@

$(VENV)/installed-tests: $(VENV)/installed
	$(PIP) ".[dev]"
	touch $@

fly: install
	$(BIN)/cfplan fly flights/figure8.yaml

test: $(VENV)/installed-tests
	$(BIN)/python -m pytest

slow: $(VENV)/installed-tests
	$(BIN)/python -m pytest -m slow

fuzz: $(VENV)/installed-tests
	$(BIN)/python -m tests.fuzzing --inputs 100000

lint: $(VENV)/installed-tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

clean:
	rm -rf $(VENV)
