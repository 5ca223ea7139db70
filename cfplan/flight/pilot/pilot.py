"""The pilot: the phases of one flight in the air, and the abort ladder that ends it early.

Each rung of the abort ladder can only be left for a graver one. The manoeuvres know how the vehicle is flown: by
setpoints, or by its on-board commander.
"""

import math
from collections.abc import Callable

from cfplan.errors import CfplanError, ExitCode, LinkError
from cfplan.flight.clock import REAL_CLOCK, Clock
from cfplan.flight.mocap.poses import PoseSource
from cfplan.flight.pilot.abort_monitor import fault_abort
from cfplan.flight.pilot.abort_reasons import Abort, AbortReason
from cfplan.flight.pilot.conducted import NO_CONDUCTOR, ConductorSource
from cfplan.flight.pilot.flight_history import FlightHistory
from cfplan.flight.pilot.flight_loop import ATTEMPTS, LINK_LOST_AFTER, AbortRaised, FlightLoop, LinkLost, OrderSource
from cfplan.flight.pilot.health import FRESH, GONE
from cfplan.flight.pilot.manoeuvres import Manoeuvres
from cfplan.flight.pilot.mission import Mission
from cfplan.flight.pilot.on_board_manoeuvres import OnBoardManoeuvres
from cfplan.flight.pilot.outcome import FlightOutcome, Rung
from cfplan.flight.pilot.prearm import prepare
from cfplan.flight.pilot.proposals import NO_PROPOSALS, ProposalSource
from cfplan.flight.pilot.streamed_manoeuvres import StreamedManoeuvres
from cfplan.flight.radio.link import Link
from cfplan.flight.radio.supervisor_bits import ARMED, LOCKED
from cfplan.flight.telemetry import Level, Phase, Telemetry

_STATUS_AFTER = 0.06  # s from an order until a status shows it: 0.04 s of the supervisor and 0.02 s of its log
_DISARM_TIMEOUT = 0.3  # s

CUT_TIMEOUT = 2.5  # s for a cut to arrive; without setpoints the vehicle stops its motors after 2 s by itself


class Pilot:
    """Flies one mission, once."""

    def __init__(
        self,
        mission: Mission,
        *,
        connect: Callable[[Callable[[], None]], Link],
        source: PoseSource,
        report: Callable[[Telemetry], None],
        orders: OrderSource,
        enter_real_time: Callable[[], None] = lambda: None,
        proposals: ProposalSource = NO_PROPOSALS,
        conductor: ConductorSource = NO_CONDUCTOR,
        clock: Clock = REAL_CLOCK,
    ):
        self._mission, self._conductor = mission, conductor
        self._connect, self._enter_real_time = connect, enter_real_time
        self._history = FlightHistory(report, clock)
        self._loop = FlightLoop(mission, source, orders, self._history, proposals, clock, conductor=conductor)
        self._manoeuvres: Manoeuvres = StreamedManoeuvres(self._loop, floor=0.0)  # replaced once the vehicle is armed

    def fly(self) -> FlightOutcome:
        """Fly all phases. Raises a CfplanError if the vehicle or its poses are not available; nothing is armed then."""
        loop = self._loop
        try:
            exit_code, reason = self._fly()
        except LinkLost:
            why = loop.link.lost or f"nothing was acknowledged for {LINK_LOST_AFTER:g} s"
            lost = AbortReason.LINK_LOST.abort(self._history.rung, reason=why)
            exit_code, reason, self._history.hint = lost.exit_code, lost.text, lost.cure
            self._history.add_event(Level.ERROR, reason)
        finally:
            self._finish()
        last_pose = loop.tracker.recent[-1] if loop.tracker.recent else None
        return self._history.outcome(loop.motion_ends + self._mission.lead, exit_code, reason, last_pose)

    def _fly(self) -> tuple[ExitCode, str]:
        """Fly the phases in order; return the exit code, and why the flight ended."""
        loop = self._loop
        try:
            floor = prepare(loop, self._connect, self._enter_real_time)
            flown = self._manoeuvres = _manoeuvres(loop, floor)
            flown.take_off()
            flown.go_to_start()
            flown.fly_plan()
            flown.land()
        except AbortRaised as raised:
            return self._leave_plan(raised.abort)
        except LinkLost:
            raise
        except Exception as error:
            if loop.airborne:  # an error must not end the program in the air
                return self._leave_plan(fault_abort(error))
            if not isinstance(error, CfplanError) or not self._history.checks:
                raise
            return error.exit_code, str(error)
        return ExitCode.OK, "landed"

    # The abort ladder.

    def _leave_plan(self, abort: Abort) -> tuple[ExitCode, str]:
        """Descend the abort ladder to the ground; return the exit code and the reason."""
        loop, flown = self._loop, self._manoeuvres
        descents = [flown.land_by_setpoints, flown.stop_and_land]  # the last one is tried; if it fails it is removed
        exit_code, reasons, self._history.hint = abort.exit_code, [abort.text], abort.cure
        while True:
            self._history.rung = max(self._history.rung, abort.rung)
            self._conductor.leave(abort)
            loop.tolerate(self._history.rung)
            level = Level.ERROR if abort.rung is Rung.CUT else Level.WARNING
            self._history.add_event(level, f"{abort.rung.name.lower()}: {abort.text}")
            try:
                if loop.airborne:
                    match abort.rung:
                        case Rung.BRAKE:
                            flown.brake()
                        case Rung.LAND:
                            descents[-1]()
                        case _:
                            self._cut()
                return exit_code, ", then ".join(reasons)
            except AbortRaised as graver:
                abort = graver.abort
            except LinkLost:
                raise
            except Exception as error:
                if abort.rung is Rung.CUT:
                    raise
                if abort.rung is Rung.LAND:
                    descents.pop()
                abort = fault_abort(error, Rung.LAND if descents else Rung.CUT)
            reasons.append(abort.text)

    def _cut(self) -> None:
        """Cut the motors at every tick until the vehicle reports that it is locked and they are off.

        The radio may lose packets, and a motor test turns the motors of a locked vehicle.
        """
        loop = self._loop
        loop.end_stream()

        def locked() -> bool:
            loop.link.emergency_stop()
            loop.link.end_motor_test()
            status = loop.link.status
            return status is not None and bool(status.supervisor & LOCKED) and not any(status.motor)

        if not locked():  # while the radio is dead, wait: it may come back, and the vehicle may have restarted
            loop.until(lambda: locked() or loop.health.uplink is not GONE, math.inf)
        if not locked() and not loop.until(locked, CUT_TIMEOUT):
            self._history.add_event(Level.ERROR, "the vehicle does not confirm that its motors were cut")
        loop.touch_down()

    # The end.

    def _finish(self) -> None:
        """Disarm and close the link on the ground; in the air the link is lost, and stays open."""
        loop = self._loop
        if loop.connected and not loop.airborne:
            self._history.enter(Phase.DISARM)
            loop.tolerate(Rung.CUT)  # the flight is over: nothing can end it any more
            loop.end_stream()
            try:
                if not self._disarm():
                    self._history.add_event(Level.WARNING, "the vehicle does not confirm that it is disarmed")
            except (LinkLost, AbortRaised):
                self._history.add_event(Level.WARNING, "the link was lost before the vehicle was disarmed")
            locked = loop.bits(LOCKED)
            loop.link.close()
            if loop.watched and not locked:
                self._restart()
        loop.close_poses()
        self._history.enter(Phase.CLOSED)

    def _disarm(self) -> bool:
        """Disarm the vehicle; return whether it confirms. If the radio is dead, wait: it may come back."""
        loop, heard = self._loop, 0
        give_up = loop.now() + LINK_LOST_AFTER

        def shown() -> bool:
            status = loop.status  # one from before the order may not show an arming that has just been ordered
            return status is not None and status.time > asked + _STATUS_AFTER and not loop.bits(ARMED)

        while heard < ATTEMPTS and loop.now() < give_up:
            asked = loop.now()
            loop.link.arm(False)
            if loop.until(shown, _DISARM_TIMEOUT):
                return True
            heard += loop.health.uplink is FRESH
        return False

    def _restart(self) -> None:
        """Restart the vehicle for the next flight, as its watchdog locks it once keep-alive packets end."""
        self._history.add_event(Level.INFO, "the vehicle restarts for the next flight")
        try:
            self._loop.link.restart()
        except LinkError as error:
            self._history.add_event(Level.WARNING, str(error))


def _manoeuvres(loop: FlightLoop, floor: float) -> Manoeuvres:
    program = loop.mission.on_board
    return StreamedManoeuvres(loop, floor) if program is None else OnBoardManoeuvres(loop, floor, program)
