"""Recompute a controller's commands from a flight's log, to check that gains, reference and start are those flown.

The firmware's control law is evaluated on the logged state and the reference at the log's times. Only the integrals at
the first record are unknown; they are fitted. Unexplained commands point to a wrong gain, mass, start or trajectory.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import minimize_scalar

from cfplan.errors import InputError
from cfplan.flight.firmware import MellingerGains
from cfplan.identification.flight_log import FlightLog
from cfplan.identification.reference import POSITION, YAW, ReferenceMotion
from cfplan.machine_code import njit
from cfplan.simulation.engine import layout, lee
from cfplan.simulation.engine.layout import MEMORY, SETPOINT, SETPOINT_SIZE, VEHICLE_SIZE
from cfplan.simulation.engine.lee import LeeGains, step_lee
from cfplan.simulation.engine.mellinger import FULL_STATE, ON_BOARD, Modes, step_mellinger
from cfplan.vehicle.airframe import GRAVITY, Airframe

LEAST_EXPLAINED = 0.95  # fraction of the commands' variance
# Fractions of the weight, N, and of weight times arm, N m: less variation, as in hover, is mostly the log's rounding.
_LEAST_VARIED = np.array([0.010, 0.015, 0.015, 0.015])
_SMOOTHING = 0.008  # s, of both: records of state and command are not of the same control step
_SEARCHED = 0.5  # s, half the range in which the start is searched for finely
_COARSE, _FINE = 0.020, 0.001  # s
_FACTORS = (0.4, 2.5)  # range of the factors by which a gain may be wrong
JERK = slice(9, 12)  # columns of a reference's rows
_ROUNDS, _LEAST_KNOWN = 3, 1e-6
_INTEGRALS = np.array([0.1, 0.1, 0.1, 0.01, 0.01, 0.01])  # their usual size at the first record
# Gains that belong together: their name for users, and the fields.
_GROUPS: dict[type, dict[str, tuple[str, ...]]] = {
    LeeGains: {
        "KR": ("KR_x", "KR_y"), "Kw": ("Kw_x", "Kw_y"), "KI": ("KI_x", "KI_y"),
        "Kpos_P": ("Kpos_Px", "Kpos_Py"), "Kpos_D": ("Kpos_Dx", "Kpos_Dy"), "Kpos_I": ("Kpos_Ix", "Kpos_Iy"),
        "Kpos_Pz": ("Kpos_Pz",), "Kpos_Dz": ("Kpos_Dz",), "Kpos_Iz": ("Kpos_Iz",), "mass": ("mass",),
    },
    MellingerGains: {
        "kR_xy": ("kR_xy",), "kw_xy": ("kw_xy",), "kp_xy": ("kp_xy",), "kd_xy": ("kd_xy",), "ki_xy": ("ki_xy",),
        "kp_z": ("kp_z",), "kd_z": ("kd_z",), "ki_z": ("ki_z",), "kd_omega_rp": ("kd_omega_rp",), "mass": ("mass",),
    },
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Controller:
    """The firmware's controller and gains of a flight."""

    gains: LeeGains | MellingerGains
    feeds_jerk: bool = True  # False: firmware whose Lee controller has no desired body rates

    @property
    def by_lee(self) -> bool:
        """Return whether it is the Lee controller."""
        return isinstance(self.gains, LeeGains)

    def setpoints(self, reference: ReferenceMotion, time: NDArray) -> NDArray:
        """Return the controller's setpoints at these times, (N, 14) for Lee's or (N, 20) for Mellinger's."""
        if not self.by_lee and len(reference.sent):
            return reference.sent_at(time)
        rows = reference.at(time)
        if self.by_lee:
            if not self.feeds_jerk:
                rows[:, JERK] = 0.0
            return rows
        setpoints = np.zeros((len(time), SETPOINT_SIZE))
        setpoints[:, :9], setpoints[:, 12], setpoints[:, 18] = rows[:, :9], 1.0, rows[:, YAW]
        setpoints[:, 13:16] = body_rates(rows)
        return setpoints


@dataclass(frozen=True, slots=True, eq=False)
class Recomputed:
    """Recomputed commands of the controller."""

    control: NDArray  # (N, 4) thrust N, torque x y z N m
    memory: NDArray  # of the controller at the first record, as fitted
    thrust: float  # explained fraction of the logged variance; NaN if not logged
    torque: float  # likewise, roll and pitch together

    @property
    def explained(self) -> float:
        """Return the smaller of both fractions."""
        return float(np.nanmin([self.thrust, self.torque]))


def recompute(log: FlightLog, reference: ReferenceMotion, controller: Controller, airframe: Airframe) -> Recomputed:
    """Return the commands that a controller gives for the logged state. Raises InputError if none were logged."""
    gains, setpoints = controller.gains.pack(), controller.setpoints(reference, log.time)
    size = lee.MEMORY_SIZE if controller.by_lee else layout.MEMORY_SIZE
    levers = np.array([airframe.arm, airframe.thrust_to_torque, getattr(controller.gains, "mass_thrust", 0.0)])
    width = _SMOOTHING / float(np.median(log.gaps))
    logged, control = log.control, np.zeros((len(log.time), 4))
    mode = FULL_STATE if len(reference.sent) else ON_BOARD
    weight = controller.gains.mass * GRAVITY
    least = _LEAST_VARIED * weight * np.array([1.0, airframe.arm, airframe.arm, airframe.arm])
    counts = log.away_from_gaps(log.time)
    spread = np.maximum(np.std(gaussian_filter1d(logged, width, axis=0)[counts], axis=0), least)
    known = np.isfinite(spread)
    if not known.any():
        hint = "log ctrlLee.thrustSI and .torquex to .torquez, or motor.m1 to .m4 with pm.vbat"
        raise InputError("it has no commands of the controller", where=log.name, hint=hint)

    def unexplained(values: NDArray) -> NDArray:
        memory = np.zeros(size)
        memory[free] = values
        _replay(control, log.time, setpoints, mode, log.state, gains, memory, levers, controller.by_lee)
        return np.asarray(((control - logged) / spread)[:, known].ravel())

    free = [k for k, gain in enumerate(_integral_gains(controller.gains)) if gain > 0.0]
    memory = np.zeros(size)
    for _ in range(_ROUNDS if free else 0):  # Gauss and Newton: nearly linear
        now = unexplained(memory[free])
        step = np.diag(1e-3 * _INTEGRALS[free])
        slopes = np.column_stack([unexplained(memory[free] + each) - now for each in step]) / np.diag(step)
        memory[free] -= np.linalg.lstsq(slopes, now, rcond=_LEAST_KNOWN)[0]
    unexplained(memory[free])
    left = np.var(gaussian_filter1d(control - logged, width, axis=0)[counts], axis=0)
    thrust, torque = 1.0 - left[0] / spread[0] ** 2, 1.0 - left[1:3].sum() / (spread[1:3] ** 2).sum()
    return Recomputed(control, memory, float(thrust), float(torque))


def find_start(
    log: FlightLog,
    reference: ReferenceMotion,
    controller: Controller,
    airframe: Airframe,
    offset: NDArray | None = None,
) -> ReferenceMotion:
    """Return the reference moved to the start at which it explains the commands best.

    Logged setpoints show start and place directly. Otherwise `offset`, (3,) m, is the place of its origin. Without an
    offset x and y are its own, and its height follows from the thrust, or from the first record if an integral gain
    hides an error of height.
    """
    if log.setpoint is not None:
        return _found_by_setpoints(log, reference, log.setpoint)
    place = np.array([0.0, 0.0, log.state[0, 2] - reference.rows[0, 2]]) if offset is None else offset
    starts = np.arange(-reference.time[-1], log.duration, _COARSE)
    apart = [_apart(log, reference.moved(start, place)) for start in starts]
    best = float(starts[int(np.argmin(apart))])

    begun = refine_start(log, reference.moved(best, place), controller, airframe, _SEARCHED)
    if offset is None and isinstance(controller.gains, LeeGains) and controller.gains.Kpos_Iz == 0.0:
        missing = np.mean(log.control[:, 0] - recompute(log, begun, controller, airframe).control[:, 0])
        begun = begun.moved(0.0, np.array([0.0, 0.0, missing / (controller.gains.mass * controller.gains.Kpos_Pz)]))
    return begun


def refine_start(
    log: FlightLog, reference: ReferenceMotion, controller: Controller, airframe: Airframe, search: float = _COARSE
) -> ReferenceMotion:
    """Return the reference moved in time by up to `search`, s, to where it explains the torque best."""

    def unexplained(later: float) -> float:
        return -recompute(log, reference.moved(later, np.zeros(3)), controller, airframe).torque

    coarse = min(np.arange(-search, search + _COARSE / 2, _COARSE), key=unexplained)
    fine = minimize_scalar(
        unexplained, bounds=(coarse - _COARSE, coarse + _COARSE), method="bounded", options={"xatol": _FINE / 2}
    )  # fmt: skip
    return reference.moved(float(fine.x), np.zeros(3))


def choose_jerk(log: FlightLog, reference: ReferenceMotion, controller: Controller, airframe: Airframe) -> Controller:
    """Return the controller, with `feeds_jerk` inverted if only that explains the torque."""
    if not controller.by_lee or recompute(log, reference, controller, airframe).torque >= LEAST_EXPLAINED:
        return controller
    other = replace(controller, feeds_jerk=not controller.feeds_jerk)
    return other if recompute(log, reference, other, airframe).torque >= LEAST_EXPLAINED else controller


def check_explained(
    log: FlightLog, reference: ReferenceMotion, controller: Controller, airframe: Airframe
) -> Recomputed:
    """Return the recomputed commands. Raises InputError if they explain too little; it names the likely cause."""
    found = recompute(log, reference, controller, airframe)
    if found.explained >= LEAST_EXPLAINED:
        return found
    likely, explained = likely_cause(log, reference, controller, airframe)
    hint = (
        f"with {likely} they would explain {explained:.1%}"
        if explained >= LEAST_EXPLAINED
        else "no single gain explains it, nor another start: check trajectory, time scale and the controller that flew"
    )
    raise InputError(
        f"the stated gains explain {found.thrust:.1%} of the thrust and {found.torque:.1%} of the torque that was "
        f"logged; {LEAST_EXPLAINED:.0%} are needed",
        where=log.name,
        hint=hint,
    )


def likely_cause(
    log: FlightLog, reference: ReferenceMotion, controller: Controller, airframe: Airframe
) -> tuple[str, float]:
    """Return the single change, of the start or a gain, that explains most, as text, and the fraction explained."""
    moved = refine_start(log, reference, controller, airframe, _SEARCHED)
    best = recompute(log, moved, controller, airframe).explained
    later = float(moved.time[0] - reference.time[0])
    text = f"a start {abs(later):.3f} s {'later' if later > 0.0 else 'sooner'}"
    for name, members in _GROUPS[type(controller.gains)].items():
        if not getattr(controller.gains, members[0]) > 0.0:
            continue

        def changed(factor: float, members: tuple[str, ...] = members) -> Controller:
            values = {each: factor * getattr(controller.gains, each) for each in members}
            return replace(controller, gains=replace(controller.gains, **values))

        def lost(factor: float) -> float:
            found = recompute(log, reference, changed(float(np.exp(factor))), airframe)
            return -float(np.nansum([found.thrust, found.torque]))

        found = minimize_scalar(lost, bounds=tuple(np.log(_FACTORS)), method="bounded", options={"xatol": 0.01})
        likely = changed(float(np.exp(found.x)))
        explained = recompute(log, reference, likely, airframe).explained
        if explained > best:
            best, text = explained, f"{name} = {getattr(likely.gains, members[0]):.3g}"
    return text, best


def body_rates(rows: NDArray) -> NDArray:
    """Return the body rates, (N, 3) rad/s, of a reference's rows, as the on-board commander computes them."""
    force = rows[:, 6:9] + np.array([0.0, 0.0, GRAVITY])
    size = np.linalg.norm(force, axis=1, keepdims=True)
    up = force / size
    heading = np.column_stack([np.cos(rows[:, YAW]), np.sin(rows[:, YAW]), np.zeros(len(rows))])
    left = np.cross(up, heading)
    left /= np.linalg.norm(left, axis=1, keepdims=True)
    ahead = np.cross(left, up)
    turning = rows[:, JERK] / size
    return np.column_stack([
        -(turning * left).sum(axis=1), (turning * ahead).sum(axis=1), rows[:, YAW + 1] * up[:, 2]
    ])  # fmt: skip


def _integral_gains(gains: LeeGains | MellingerGains) -> tuple[float, ...]:
    """Return the gains of the integrals in the order of the controller's memory."""
    if isinstance(gains, LeeGains):
        return gains.Kpos_Ix, gains.Kpos_Iy, gains.Kpos_Iz, gains.KI_x, gains.KI_y, gains.KI_z
    return gains.ki_xy, gains.ki_xy, gains.ki_z, gains.ki_m_xy, gains.ki_m_xy, gains.ki_m_z


def _found_by_setpoints(log: FlightLog, reference: ReferenceMotion, setpoint: NDArray) -> ReferenceMotion:
    """Return the reference moved in time and place onto the logged setpoints."""

    def moved(start: float) -> tuple[ReferenceMotion, float]:
        begun = reference.moved(start, np.zeros(3))
        rows = begun.at(log.time)
        offset = np.median(setpoint[:, :3] - rows[:, POSITION], axis=0)
        left = np.hstack([rows[:, POSITION] + offset, rows[:, 3:6]]) - setpoint[:, :6]
        return begun.moved(0.0, offset), float(np.mean(left**2))

    starts = np.arange(-reference.time[-1], log.duration, _COARSE)
    best = float(min(starts, key=lambda start: moved(float(start))[1]))
    fine = np.arange(best - _COARSE, best + _COARSE, _FINE)
    return moved(float(min(fine, key=lambda start: moved(float(start))[1])))[0]


def _apart(log: FlightLog, reference: ReferenceMotion) -> float:
    """Return the mean squared distance in x and y of the estimate from a reference, at every tenth record, m²."""
    off = reference.at(log.time[::10])[:, :2] - log.state[::10, :2]
    return float(np.mean((off - off.mean(axis=0)) ** 2))


@njit(error_model="numpy")
def _replay(
    control: NDArray, time: NDArray, setpoints: NDArray, mode: Modes, states: NDArray, gains: NDArray,
    memory: NDArray, levers: NDArray, by_lee: bool,
) -> None:  # fmt: skip
    """Write the commands at every record, from the controller's `memory` at the first.

    `levers`: arm m, yaw torque per thrust m, 16-bit units per N.
    """
    vehicle = np.zeros(VEHICLE_SIZE)
    vehicle[MEMORY : MEMORY + len(memory)] = memory
    for k in range(len(time)):
        period = time[k] - time[k - 1] if k > 0 else 0.002
        if by_lee:
            step_lee(control[k], memory, gains, setpoints[k], states[k], period)
        else:
            vehicle[SETPOINT : SETPOINT + SETPOINT_SIZE] = setpoints[k]
            asked = step_mellinger(vehicle, gains, mode, states[k], period)
            control[k, 0], control[k, 1] = asked[0] / levers[2], 0.5 * levers[0] * asked[1] / levers[2]
            control[k, 2] = -0.5 * levers[0] * asked[2] / levers[2]
            control[k, 3] = -levers[1] * asked[3] / levers[2]
