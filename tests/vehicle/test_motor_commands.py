"""Motor commands: PWM after battery compensation and back."""

from dataclasses import replace

import numpy as np
import pytest

from cfplan.vehicle.airframes import AIRFRAMES
from cfplan.vehicle.motor_commands import FULL_COMMAND, command_shares, compensated_pwm

KINDS = ["crazyflie-2.1+", "crazyflie-thrust-upgrade", "crazyflie-2.1-brushless"]


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("voltage", [3.6, 3.9, 4.2])
def test_shares_come_back_from_the_pwm(name, voltage):
    airframe, shares = AIRFRAMES[name], np.linspace(0.12, 1.0, 12)
    pwm = np.array([compensated_pwm(share, voltage, airframe) for share in shares])
    assert (np.diff(pwm) > 0.0).all()
    given = command_shares(np.round(pwm)[:, None], np.full(len(pwm), voltage), airframe)[:, 0]
    np.testing.assert_allclose(given[pwm < FULL_COMMAND], shares[pwm < FULL_COMMAND], atol=1e-4)


def test_the_fits_are_those_that_the_2_1_plus_was_measured_with():
    airframe = AIRFRAMES["crazyflie-2.1+"]
    full = np.full((3, 1), FULL_COMMAND)
    thrust = 0.12 * command_shares(full, np.array([3.0, 3.5, 3.7]), airframe)[:, 0]
    assert thrust == pytest.approx([0.113, 0.166, 0.193], abs=0.001)  # N at a motor's voltage


def test_about_hover_thrust_grows_faster_with_the_pwm_than_with_a_share():
    airframe = AIRFRAMES["crazyflie-2.1+"]
    hover = airframe.hover_thrust / airframe.motor_thrust_max
    slope = 0.001 / (compensated_pwm(hover + 0.001, 3.78, airframe) - compensated_pwm(hover, 3.78, airframe))
    assert 0.12 * slope * FULL_COMMAND == pytest.approx(0.22, abs=0.01)  # N per full scale


def test_a_motor_that_is_off_is_off_and_an_empty_battery_gives_full_pwm():
    airframe = AIRFRAMES["crazyflie-2.1+"]
    assert compensated_pwm(0.0, 3.8, airframe) == 0.0
    assert compensated_pwm(0.5 * airframe.motor_thrust_min / 0.12, 3.8, airframe) == 0.0
    assert compensated_pwm(airframe.motor_thrust_min / 0.12, 3.8, airframe) > 0.0
    assert compensated_pwm(1.0, 2.9, airframe) == FULL_COMMAND
    assert compensated_pwm(1.0, 1.5, airframe) == 0.0
    assert command_shares(np.zeros((1, 4)), np.array([3.8]), airframe) == pytest.approx(np.zeros((1, 4)))


def test_without_compensation_the_pwm_is_the_share():
    airframe = replace(AIRFRAMES["crazyflie-2.1+"], motor_curve=(0.0, 0.0, 0.0, 0.0, 0.0))
    assert compensated_pwm(0.4, 3.7, airframe) == pytest.approx(0.4 * FULL_COMMAND)
    assert command_shares(np.array([[26214.0]]), np.array([3.7]), airframe)[0, 0] == pytest.approx(0.4)
