"""The examples fly as they stand, on the virtual vehicle and the stepped clock."""

import ast
import importlib.util
import json
from dataclasses import replace
from pathlib import Path
from types import ModuleType

import pytest

import cfplan
from cfplan.errors import ExitCode
from cfplan.simulation.virtual_crazyflie.battery import CAPACITY
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.steering.steered_vehicle import SteeredVehicle
from cfplan.steering.stepped_steering import SteppedSteering

EXAMPLES = Path(__file__).parents[2] / "examples"


def example(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def vehicle(limits):
    with cfplan.connect("sim://0", stepped=True, safety=limits, records=None) as connected:
        yield connected
    assert connected.outcome.exit_code is ExitCode.OK
    assert connected.outcome.deviation.max < 0.15


def test_a_moving_target_is_followed(vehicle):
    accepted, distance = example("follow_a_target").fly(vehicle, 6.0)
    assert accepted > 8
    assert distance < 0.6


def test_a_tour_of_random_waypoints_goes_on(vehicle):
    accepted, _ = example("random_tour").fly(vehicle, 8.0)
    assert accepted >= 3


@pytest.mark.slow
def test_a_tour_goes_on_for_ten_minutes_with_a_battery_that_lasts(limits):
    lasting = replace(limits, battery=replace(limits.battery, endurance=900.0))
    flight = SteppedSteering(lasting, vehicle=VehicleSettings(capacity=10.0 * CAPACITY))
    with SteeredVehicle(flight, lasting, uri="sim://0") as vehicle:
        accepted, refused = example("random_tour").fly(vehicle, 600.0)
    assert vehicle.outcome.exit_code is ExitCode.OK
    assert vehicle.outcome.deviation.max < 0.05
    assert accepted > 100
    assert refused <= 3  # drawn too near to one another


def test_a_gate_that_moves_is_flown_through(vehicle):
    missed = example("race_a_moving_gate").fly(vehicle, 1)
    assert max(missed) < 0.1


def test_keys_move_the_vehicle_and_what_cannot_be_flown_is_refused(vehicle, capsys):
    held = [["up"] * 3] * 6 + [[]] * 6 + [["a"] * 2, ["r"]] * 3 + [[]] * 8 + [["x"], ["f"] * 20, [], [], ["q"]]
    places = []

    def keys():
        places.append(vehicle.position)
        return held[len(places) - 1]

    accepted = example("teleoperate").fly(vehicle, keys)
    assert accepted >= 8
    begun, reached = places[0], places[26]
    assert 0.9 < reached[0] - begun[0] < 1.9
    assert 0.4 < reached[1] - begun[1] < 0.8
    assert 0.2 < reached[2] - begun[2] < 0.4
    assert "too far out" in capsys.readouterr().out
    assert len(places) == len(held)


def test_a_plan_is_made_saved_and_rehearsed(tmp_path):
    duration, deviation = example("plan_and_rehearse").plan_and_rehearse(
        [[0, 0, 1], [1, 0, 1], [1, 1, 1.2]], str(EXAMPLES.parent / "safety.yaml"), str(tmp_path / "plan.parquet")
    )
    assert 0.5 < duration < 10.0
    assert 0.0 < deviation < 0.15
    assert (tmp_path / "plan.parquet").exists()


def test_every_example_is_tested():
    here = Path(__file__).read_text()
    assert all(f'example("{file.stem}")' in here for file in EXAMPLES.glob("*.py"))


def test_examples_use_nothing_of_cfplan_but_what_its_top_level_offers():
    notebook = json.loads((EXAMPLES / "notebook.ipynb").read_text())
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    for source in ["\n".join(cells), *[file.read_text() for file in EXAMPLES.glob("*.py")]]:
        nodes = list(ast.walk(ast.parse(source)))
        imported = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
        imported |= {node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)}
        assert "cfplan" in imported
        assert not [name for name in imported if name.startswith("cfplan.")]
        used = {
            node.attr
            for node in nodes
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "cfplan"
        }
        assert used
        assert used <= set(cfplan.__all__)


def test_every_name_of_the_top_level_is_there():
    assert all(getattr(cfplan, name) is not None for name in cfplan.__all__)
