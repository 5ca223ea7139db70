# Two commands: `make fly` flies the virtual Crazyflie, `make test` runs every test but the slow ones.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: install fly test slow lint clean

install: $(VENV)/installed

$(VENV)/installed: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --disable-pip-version-check --quiet --editable ".[dev]"
	touch $@

fly: install
	$(BIN)/cfplan fly flights/figure8.yaml

test: install
	$(BIN)/python -m pytest

slow: install
	$(BIN)/python -m pytest -m slow

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

clean:
	rm -rf $(VENV)
