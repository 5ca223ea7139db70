"""One flight of a vehicle that is not as its lab believes, flown in the stepped lab and read back from its record."""

from pathlib import Path

import pytest

from cfplan.preparation.prepare_flight import prepare_mission
from cfplan.safety.limits_file import load_limits
from studies.identification import draw_vehicle, fly_drawn, unknown_vehicle

REPOSITORY = Path(__file__).parents[2]
SEED = 4


@pytest.fixture(scope="session")
def limits():
    return unknown_vehicle(load_limits(REPOSITORY / "safety.yaml"))


@pytest.fixture(scope="session")
def drawn(limits):
    return draw_vehicle(SEED, limits.airframe)


@pytest.fixture(scope="session")
def mission(limits):
    return prepare_mission(REPOSITORY / "flights" / "identify.yaml", limits)


@pytest.fixture(scope="session")
def record(drawn, mission, tmp_path_factory):
    return fly_drawn(drawn, mission, tmp_path_factory.mktemp("identify") / "record", seed=SEED)[0]
