"""The firmware's Lee controller against the firmware's own outputs, and its integrals in hover."""

import numpy as np
import pytest

from cfplan.simulation.engine.layout import QUATERNION, at_rest
from cfplan.simulation.engine.lee import MEMORY_SIZE, REFERENCE_SIZE, LeeGains, divide_power, step_lee
from cfplan.vehicle.rotations import yaw_of

ARM, THRUST_TO_TORQUE, THRUST_MAX = (
    0.046 / 2**0.5,
    0.0069928948992470565,
    0.12,
)  # as the firmware's power distribution has them


def reference_of(setpoint):
    """The reference, without jerk, of a full-state setpoint, (16,)."""
    reference = np.zeros(REFERENCE_SIZE)
    reference[:9], reference[12], reference[13] = setpoint[:9], yaw_of(setpoint[9:13]), setpoint[15]
    return reference


def test_control_and_motors_are_the_firmwares(firmware):
    recorded = firmware("lee")
    gains, control, motors = LeeGains(mass=float(recorded["mass"])).pack(), np.zeros(4), np.zeros(4)
    for setpoints, states, controls, thrusts in zip(
        *(recorded[name].astype(float) for name in ("setpoint", "state", "control", "motor_thrust_N")), strict=True
    ):
        memory, ours, our_thrusts = np.zeros(MEMORY_SIZE), np.empty_like(controls), np.empty_like(thrusts)
        for k, (setpoint, state) in enumerate(zip(setpoints, states, strict=True)):
            step_lee(control, memory, gains, reference_of(setpoint), state, 0.002)
            divide_power(control, (ARM, THRUST_TO_TORQUE), THRUST_MAX, motors)
            ours[k], our_thrusts[k] = control, motors
        np.testing.assert_allclose(ours, controls, atol=1e-6)
        np.testing.assert_allclose(our_thrusts, thrusts, atol=1e-5)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_integrals_grow_while_an_error_stays(axis):
    gains = LeeGains(Kpos_Ix=5.0, Kpos_Iy=5.0, Kpos_Iz=5.0, mass=0.032).pack()
    reference, state, control = np.zeros(REFERENCE_SIZE), at_rest(np.zeros(3)), np.zeros(4)
    reference[axis] = 0.1
    memory, first = np.zeros(MEMORY_SIZE), np.zeros(4)
    for k in range(500):
        step_lee(control, memory, gains, reference, state, 0.002)
        if k == 0:
            first = control.copy()
    assert memory[axis] == pytest.approx(0.1, abs=1e-9)  # m s
    turned = {0: 2, 1: 1, 2: 0}[axis]  # the control that moves it along this axis
    assert abs(control[turned]) > abs(first[turned]) + 1e-4


def test_without_thrust_the_integrals_are_cleared():
    reference, state, control, memory = np.zeros(REFERENCE_SIZE), at_rest(np.zeros(3)), np.zeros(4), np.ones(6)
    state[QUATERNION] = 1.0, 0.0, 0.0, 0.0  # upside down
    step_lee(control, memory, LeeGains().pack(), reference, state, 0.002)
    assert memory == pytest.approx(np.zeros(6))
    assert control[0] < 0.0
