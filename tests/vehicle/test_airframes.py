"""Airframes by name against their sources, and one's own by a file."""

from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import yaml

from cfplan.errors import InputError
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.airframes import AIRFRAMES, load_airframe

FIRMWARE = Path(__file__).parents[3] / "shared" / "data" / "firmware"


@pytest.mark.parametrize("name", AIRFRAMES)
def test_every_airframe_hovers_and_says_where_its_numbers_are_from(name):
    airframe = load_airframe(name)
    assert airframe.name == name
    assert airframe.motor_thrust_min < airframe.hover_thrust < airframe.motor_thrust_max
    assert len(airframe.source) > 20


def test_the_2_0_is_rotorpys():
    from rotorpy.vehicles.crazyflie_params import quad_params

    airframe = load_airframe("crazyflie-2.0")
    assert airframe.mass == quad_params["mass"]
    assert airframe.inertia == (quad_params["Ixx"], quad_params["Iyy"], quad_params["Izz"])
    assert airframe.arm == pytest.approx(quad_params["rotor_pos"]["r1"][0])
    assert airframe.motor_thrust_max == pytest.approx(quad_params["k_eta"] * quad_params["rotor_speed_max"] ** 2)
    assert airframe.thrust_to_torque == pytest.approx(quad_params["k_m"] / quad_params["k_eta"])
    assert airframe.motor_time_constant == quad_params["tau_m"]
    hover = np.sqrt(airframe.mass * GRAVITY / 4 / quad_params["k_eta"])
    assert airframe.drag == pytest.approx((4 * quad_params["k_d"] * hover, 4 * quad_params["k_z"] * hover))


@pytest.mark.skipif(not FIRMWARE.is_dir(), reason="the firmware's numbers are not beside this checkout")
def test_the_2_1_plus_is_the_body_that_the_firmware_was_flown_on():
    body = np.load(FIRMWARE / "closed_loop_mellinger_0.npz")
    airframe = load_airframe("crazyflie-2.1+")
    assert airframe.mass == body["mass"]
    assert airframe.inertia == pytest.approx(tuple(body["inertia_diag"]))
    assert (airframe.drag[0], airframe.drag[0], airframe.drag[1]) == pytest.approx(tuple(body["drag"]))
    assert airframe.motor_time_constant == body["motor_tau"]
    assert airframe.arm == pytest.approx(float(body["arm_per_axis"]))
    assert airframe.thrust_to_torque == pytest.approx(float(body["thrust_to_torque"]))
    assert airframe.motor_thrust_max == body["thrust_max_N"]


@pytest.mark.parametrize("name", [name for name in AIRFRAMES if name != "crazyflie-2.0"])
def test_a_vehicle_of_public_flights_has_their_moment_and_lift(name):
    airframe = AIRFRAMES[name]
    assert all(4e-4 < moment < 8e-4 for moment in airframe.velocity_moment)
    assert 0.3 < airframe.drag[0] / airframe.mass < 0.45  # 1/s
    assert airframe.lift_with_speed > 0.0
    assert airframe.simplified().velocity_moment == (0.0, 0.0)


@pytest.mark.parametrize(("scale", "most"), [(1.05, 0.12), (0.9, 0.108)])
def test_a_thrust_scale_is_told_to_the_controller_and_only_lowers_what_plans_count_on(scale, most):
    airframe = replace(AIRFRAMES["crazyflie-2.1+"], thrust_scale=scale)
    assert airframe.command_per_thrust == pytest.approx(65535 / (4 * 0.12 * scale))
    assert airframe.thrust_range[1] == pytest.approx(most)
    assert airframe.thrust_range[0] >= airframe.motor_thrust_min


def test_an_unknown_vehicle_is_refused_with_the_known_ones():
    with pytest.raises(InputError, match=r"unknown vehicle 'crazyflie-2\.1'") as error:
        load_airframe("crazyflie-2.1")
    assert "did you mean crazyflie-2.1+?" in error.value.hint
    assert all(name in error.value.hint for name in AIRFRAMES)


def written(tmp_path, **changes):
    values = asdict(AIRFRAMES["crazyflie-2.1+"]) | changes
    plain = {key: list(v) if isinstance(v, tuple) else v for key, v in values.items() if v is not None}
    file = tmp_path / "own.yaml"
    file.write_text(yaml.safe_dump(plain, sort_keys=False))
    return file


def test_an_airframe_of_ones_own_is_read_from_a_file(tmp_path):
    airframe = load_airframe(written(tmp_path, name="mine", mass=0.035))
    assert (airframe.name, airframe.mass) == ("mine", 0.035)
    assert load_airframe(str(written(tmp_path, mass=0.035))).mass == 0.035


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mass": -0.03}, "mass"),
        ({"mass": 31.8}, "mass"),
        ({"mass": 0.06}, "cannot hover"),
        ({"motor_thrust_max": 0.0}, "motor_thrust_max"),
        ({"inertia": (1e-5, 1e-5, 5e-5)}, "no rigid body"),
        ({"inertia": (1e-5, 1e-5)}, "inertia"),
        ({"colour": "red"}, "colour"),
        ({"arm": None}, "'arm' is missing"),
    ],
)
def test_a_wrong_airframe_file_is_refused_with_the_line(tmp_path, changes, message):
    with pytest.raises(InputError, match=r"own\.yaml:\d+:\d+: .*" + message):
        load_airframe(written(tmp_path, **changes))
