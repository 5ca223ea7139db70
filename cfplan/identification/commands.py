"""Collective command: restore the motors' command at every millisecond from a log that samples it every 20 ms.

The controller's command is a staircase. It steps when a setpoint arrives and when the vehicle's filter predicts, both
every 10 ms, and the log samples it in step with them, always at the same phase. Interpolating the samples would err by
up to half a step, always to the same side: a third of the rotor drag along the thrust axis and some 10 ms of motor lag.
So the steps between the samples are restored by the firmware's law from the logged estimates and the sent setpoints.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.flight.firmware import gains_for
from cfplan.identification.attitude import grid_of
from cfplan.identification.signals import FlightSignals
from cfplan.vehicle.airframe import GRAVITY
from cfplan.vehicle.rotations import matrices_of

LARGEST_DELAY = 0.040  # s, longest delay of a setpoint on its way to the vehicle
PERIOD = 0.010  # s, of the filter's predictions
_STEP = 0.001  # s
_RESIDUAL_SMOOTHING = 1.0  # s: the part of the command that the law leaves unexplained changes more slowly
_MISFIT_TOLERANCE = 1.15  # times the least misfit, up to which a delay counts as equally good


@dataclass(frozen=True, slots=True)
class CollectiveCommand:
    """The sum of the motors' commands on the grid, for any delay and phase of its steps."""

    signals: FlightSignals
    grid: NDArray
    estimate: NDArray  # (K, 9) position, velocity, thrust axis as estimated on board
    delays: tuple[float, float]  # s, least and largest that the log's samples allow

    def at(self, delay: float, phase: float) -> NDArray:
        """Return the command on the grid.

        `delay`, s: from sending a setpoint to its taking effect. `phase`, s: from a message of the log to the filter's
        next prediction. Between whole milliseconds it is interpolated, so that it changes smoothly with both.
        """
        total = np.zeros(len(self.grid))
        for by_delay, weight in _neighbours(delay):
            for by_phase, other in _neighbours(phase):
                if weight * other > 0.0:
                    total += weight * other * self._stairs(by_delay, by_phase)
        return total

    def _stairs(self, delay: float, phase: float) -> NDArray:
        signals = self.signals
        left = signals.collective - self._law(signals.status_time, delay, _nearest(signals))
        following = np.searchsorted(signals.estimate_time, self.grid - phase, side="right")
        following = np.minimum(following, len(signals.estimate_time) - 1)
        return self._law(self.grid, delay, following) + np.interp(self.grid, signals.status_time, left)

    def _law(self, time: NDArray, delay: float, row: NDArray) -> NDArray:
        """Return the controller's command at `time` for the estimates of these rows, without integrals."""
        return _law(self.signals, self.estimate, time, delay, row)


def collective_command(signals: FlightSignals) -> CollectiveCommand:
    """Return the collective command of a flight."""
    axis = matrices_of(signals.estimate[:, 6:10])[:, :, 2]
    estimate = np.hstack([signals.estimate[:, 0:6], axis])
    return CollectiveCommand(signals, grid_of(signals), estimate, _possible_delays(signals, estimate))


def _possible_delays(signals: FlightSignals, estimate: NDArray) -> tuple[float, float]:
    """Return the least and largest delay, s, with which the law agrees with the log: those that change no sample."""
    inside = (signals.status_time > 0) & (signals.status_time < signals.duration)
    time, row = signals.status_time[inside], _nearest(signals)[inside]
    count = max(3, round(_RESIDUAL_SMOOTHING / float(np.median(np.diff(time)))) | 1)
    delays = np.arange(0.0, LARGEST_DELAY, _STEP)
    misfits = []
    for delay in delays:
        left = signals.collective[inside] - _law(signals, estimate, time, delay, row)
        padded = np.pad(left, count // 2, mode="edge")
        misfits.append(np.std(left - np.convolve(padded, np.ones(count) / count, "valid")))
    # After a whole period the law gives nearly the same again: take the earliest of the equally good delays.
    good = np.array(misfits) <= _MISFIT_TOLERANCE * min(misfits)
    low = high = int(np.argmax(good))
    while high + 1 < len(delays) and good[high + 1]:
        high += 1
    return float(delays[low]), float(delays[high])


def _law(signals: FlightSignals, estimate: NDArray, time: NDArray, delay: float, row: NDArray) -> NDArray:
    """Return the Mellinger controller's collective command, as a fraction of the full command, without integrals."""
    airframe, gains = signals.airframe, gains_for(signals.airframe)
    sent = np.clip(np.searchsorted(signals.sent_time, time - delay, side="right") - 1, 0, len(signals.sent_time) - 1)
    wanted, believed = signals.setpoint[sent], estimate[row]
    stiffness = np.array([gains.kp_xy, gains.kp_xy, gains.kp_z])
    damping = np.array([gains.kd_xy, gains.kd_xy, gains.kd_z])
    force = airframe.mass * (wanted[:, 6:9] + [0.0, 0.0, GRAVITY])
    force += stiffness * (wanted[:, 0:3] - believed[:, 0:3]) + damping * (wanted[:, 3:6] - believed[:, 3:6])
    return np.einsum("ni,ni->n", force, believed[:, 6:9]) / (airframe.motor_thrust_max * airframe.thrust_scale)


def _nearest(signals: FlightSignals) -> NDArray:
    """Return the estimate that was logged with each message of status."""
    rows = np.arange(len(signals.estimate_time))
    return np.round(np.interp(signals.status_time, signals.estimate_time, rows)).astype(int)


def _neighbours(value: float) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return the whole milliseconds on both sides, s, with their weights."""
    steps = value / _STEP
    low = np.floor(steps)
    weight = float(steps - low)
    return (float(low * _STEP), 1.0 - weight), (float((low + 1.0) * _STEP), weight)
