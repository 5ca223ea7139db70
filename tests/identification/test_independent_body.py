"""The fit against a body that shares no code with it: an integrator of scipy's, with markers off centre and turned."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from cfplan.identification.identify import fit_unknowns
from cfplan.identification.quantities import assemble
from cfplan.identification.signals import FlightSignals
from cfplan.identification.translation import flight_model
from cfplan.vehicle.airframes import AIRFRAMES

NOMINAL = AIRFRAMES["crazyflie-2.1+"].simplified()
MASS, THRUST_MAX, LAG, DRAG, AXIAL_DRAG = 0.0335, 0.113, 0.082, 0.0181, 0.0102
ORIGIN, MOUNTING, LATE = np.array([0.006, -0.004, 0.012]), np.array([0.02, -0.03, 0.05]), 0.023
HOVER = MASS * 9.81 / THRUST_MAX
GYRO_BIAS, DURATION = np.array([0.005, -0.004, 0.003]), 20.0


def fly(liveliness):
    """Return what is measured of a flight with so much of tilting and climbing; 0 is a hover."""

    def attitude(time):
        roll, pitch, yaw = 0.35 * np.sin(2.1 * time), 0.3 * np.sin(1.7 * time + 1), 1.2 * np.sin(0.6 * time)
        return Rotation.from_euler("xyz", liveliness * np.stack([roll, pitch, yaw], axis=-1))

    def command(time):
        """Share of the full command, of all motors together."""
        return HOVER + liveliness * (0.55 * np.sin(3.3 * time) + 0.35 * np.sin(5.7 * time + 0.5))

    def rate(time):
        step = 1e-5
        return (attitude(time - step).inv() * attitude(time + step)).as_rotvec() / (2 * step)

    def motion(time, state):
        turn = attitude(time)
        along = turn.inv().apply(state[3:6])
        force = np.array([-DRAG * along[0], -DRAG * along[1], THRUST_MAX * state[6] - AXIAL_DRAG * along[2]])
        acceleration = turn.apply(force) / MASS - [0.0, 0.0, 9.81]
        return np.concatenate([state[3:6], acceleration, [(command(time) - state[6]) / LAG]])

    flown = solve_ivp(
        motion, (-0.5, DURATION + 0.5), [0, 0, 1, 0, 0, 0, HOVER], rtol=1e-9, atol=1e-9, dense_output=True
    )
    chance = np.random.default_rng(3)
    seen, logged = np.arange(-0.2, DURATION + 0.2, 0.01), np.arange(-0.3, DURATION + 0.3, 0.02)
    markers = attitude(seen) * Rotation.from_rotvec(MOUNTING)
    noisy = markers * Rotation.from_rotvec(chance.normal(0.0, np.radians(0.2), (len(seen), 3)))
    position = flown.sol(seen)[:3].T + attitude(seen).apply(ORIGIN) + chance.normal(0.0, 0.001, (len(seen), 3))
    sent = np.arange(-0.3, DURATION + 0.3, 0.01)
    still = np.zeros((len(sent), 10))
    still[:, 9] = 1.0
    gyro = rate(logged) + GYRO_BIAS + chance.normal(0.0, 0.01, (len(logged), 3))
    # The controller's law says nothing here: estimate and setpoints stand still, and the command is smooth.
    return FlightSignals(
        airframe=NOMINAL, duration=DURATION, behind=0.010, pose_time=seen + LATE - 0.010, position=position,
        quaternion=noisy.as_quat(), status_time=logged, gyro=gyro,
        command=np.repeat(command(logged)[:, None] / 4, 4, axis=1), voltage=np.linspace(3.9, 3.7, len(logged)),
        estimate_time=sent, estimate=still, sent_time=sent, setpoint=np.zeros((len(sent), 9)),
    )  # fmt: skip


def identified(signals):
    models = [flight_model(signals, 3.8)]
    return assemble(models, fit_unknowns(models), mass=MASS, voltage=3.8)


def test_the_independent_body_is_found():
    found = identified(fly(1.0))
    quantities = found.quantities
    assert found.airframe.thrust_scale * NOMINAL.motor_thrust_max == pytest.approx(THRUST_MAX, rel=0.003)
    assert found.airframe.drag[0] == pytest.approx(DRAG, rel=0.03)
    assert found.airframe.drag[1] == pytest.approx(AXIAL_DRAG, rel=0.05)
    assert found.airframe.motor_time_constant == pytest.approx(LAG, abs=0.002)
    assert found.pose_latency == pytest.approx(LATE + 0.002, abs=0.0015)  # less the way of a real log's messages
    turned = [quantities[f"mounting {name}"].value for name in ("roll", "pitch", "yaw")]
    np.testing.assert_allclose(turned, MOUNTING, atol=np.radians(0.3))
    for axis, origin in zip("xyz", Rotation.from_rotvec(MOUNTING).inv().apply(ORIGIN), strict=True):
        quantity = quantities[f"origin {axis}"]
        assert abs(quantity.value - origin) < 3 * quantity.deviation < 0.01
    assert found.misfit == pytest.approx(0.001, rel=0.1)


def test_what_a_hover_cannot_tell_is_said_and_kept():
    found = identified(fly(0.0))
    for name in ("motor lag", "drag", "axial drag"):
        assert "too uncertain" in found.quantities[name].unobservable_reason
    assert found.airframe.motor_time_constant == NOMINAL.motor_time_constant
    assert found.airframe.drag == NOMINAL.drag
    assert found.airframe.thrust_scale * NOMINAL.motor_thrust_max == pytest.approx(THRUST_MAX, rel=0.01)
