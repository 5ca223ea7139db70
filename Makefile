# `make fly` installs what flies and flies the virtual Crazyflie; `make test` installs what tests and runs the tests.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --disable-pip-version-check --editable

# Runs what says nothing for half a minute, as pip does while it unpacks, and shows meanwhile how many packages there are;
# not while pip draws bars, before it has added to its own two.
define counting_packages
	@echo '$(1)'
	@(while sleep 5 >/dev/null 2>&1; do \
		set -- $(VENV)/lib/python*/site-packages/*.dist-info; [ -e "$$1" ] || shift; \
		if [ $$# -gt 2 ] || [ $$# -eq 0 ] || ! [ -t 1 ]; then echo "$(VENV): $$# packages so far"; fi; \
	done) & counting=$$!; trap "kill $$counting" EXIT; $(1)
endef

PYTEST := $(BIN)/python -m pytest --numprocesses logical --maxprocesses 4 --dist loadfile
PROCESSORS := own older plain mixed

.PHONY: install fly test test-processors slow slow-stepped fuzz dist release site pictures lint clean

install: $(VENV)/installed

$(VENV)/installed: pyproject.toml
	$(call counting_packages,$(PYTHON) -m venv $(VENV))
	$(call counting_packages,$(PIP) .)
	$(BIN)/cfplan doctor --warm-up
	touch $@

$(VENV)/installed-tests: $(VENV)/installed
	$(call counting_packages,$(PIP) ".[dev]")
	touch $@

fly: install
	$(BIN)/cfplan fly flights/figure8.yaml

test: $(VENV)/installed-tests
	$(PYTEST)

# The same tests with the rounding of other processors, by the settings in tests/processors.py.
test-processors: $(PROCESSORS:%=test-as-%)

# Without the tests of the planner's process: they go by the computer's clock, and slower code answers late.
test-as-%: $(VENV)/installed-tests
	$(BIN)/python -m tests.processors $* $(BIN)/cfplan doctor --warm-up
	$(BIN)/python -m tests.processors $* $(PYTEST) --ignore tests/air/test_process.py

slow: slow-stepped
	$(BIN)/python -m pytest -m slow -k in_real_time

# Those of the slow tests that do not go by the computer's clock.
slow-stepped: $(VENV)/installed-tests
	$(PYTEST) -m slow -k "not in_real_time"

fuzz: $(VENV)/installed-tests
	$(BIN)/python -m pytest -m "hypothesis and not slow" --hypothesis-profile=random
	$(BIN)/python -m tests.bad_input --inputs 100000

# An archive of the sources, and the wheel made from that archive, in dist/.
dist: $(VENV)/installed-tests
	$(BIN)/python -m build

# What a release needs: README's figures are of these sources, and everything passes.
release: $(VENV)/installed-tests
	$(BIN)/python -m studies pages --fresh
	$(MAKE) lint site test dist

# The documentation as a site, in build/site.
site: $(VENV)/installed-tests
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

# The pictures of docs/; needs a Vulkan driver (mesa-vulkan-drivers) and chromium, and a computer that does nothing else.
pictures: install
	rm -rf build/pictures
	$(BIN)/cfplan fly flights/figure8.yaml --records build/pictures/figure8
	$(BIN)/cfplan fly flights/line.yaml --records build/pictures/line
	$(BIN)/cfplan fly flights/line.yaml --records build/pictures/line --mocap vicon://lab/cf1
	$(BIN)/cfplan replay build/pictures/figure8/* --png docs/images/replay.png --at 17.8 --force
	$(BIN)/cfplan replay build/pictures/line/* --png docs/images/trials.png --at 2.4 --force
	$(BIN)/cfplan replay build/pictures/figure8/* --gif docs/images/flight.gif --force
	$(BIN)/cfplan fly flights/loop3d.yaml --records build/pictures/loop3d
	$(BIN)/cfplan replay build/pictures/loop3d/* --figure docs/images/flight.png --force
	for path in lawn-mower gates corridor; do \
		$(BIN)/cfplan plan examples/paths/$$path.yaml --figure docs/images/$$path.png --force || exit 1; \
	done
	$(BIN)/cfplan plan examples/paths/obstacles.yaml --safety examples/paths/furnished-room.yaml \
		--figure docs/images/obstacles.png --force
	$(BIN)/python -m studies figures
	$(BIN)/cfplan report build/pictures/figure8/* -o build/pictures/report.html --force
	chromium --headless --no-sandbox --hide-scrollbars --window-size=1200,1500 \
		--screenshot=docs/images/report.png file://$(CURDIR)/build/pictures/report.html

lint: $(VENV)/installed-tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

clean:
	rm -rf $(VENV)
