"""On-board manoeuvres: the vehicle's own commander flies, and the pilot commands, watches, and ends the flight.

The commander flies the take-off, the way to the start, and the uploaded trajectory with the landing at its end; if the
abort ladder requires it, also a stop from any state and a landing. Only poses and keep-alive packets are streamed. The
commander has no time-out. The watchdog, which is started before the motors turn, stops them a second after the last
keep-alive packet.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import PreflightError
from cfplan.flight.on_board import commands
from cfplan.flight.on_board.go_to import STOP_DURATION, go_to_states, motion_of, stop_targets
from cfplan.flight.on_board.program import OnBoardProgram
from cfplan.flight.pilot.abort_reasons import AbortReason
from cfplan.flight.pilot.flight_loop import ATTEMPTS, AbortRaised, FlightLoop
from cfplan.flight.pilot.health import FRESH, GONE
from cfplan.flight.pilot.landing import Landing, stands_by_poses, stop_until_confirmed
from cfplan.flight.pilot.manoeuvres import begin_take_off, climb, settle_at
from cfplan.flight.pilot.mission import go_to_time
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.pilot.stream import Stream
from cfplan.flight.pilot.streamed_manoeuvres import BRAKE_HOLD
from cfplan.flight.radio.perishable import MAX_AGE
from cfplan.flight.radio.supervisor_bits import TRAJECTORY_FINISHED
from cfplan.flight.setpoints.encoding import encode_motion
from cfplan.flight.setpoints.packets import PAYLOAD_SIZE, decode
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.flight.telemetry import Level, Phase
from cfplan.vehicle.rotations import yaw_of

ANSWER_TIMEOUT = 0.3  # s
_KEEP_ALIVE_TIME = 0.4  # s of keep-alive packets before the motors turn; the first to arrive starts the watchdog
_QUICK_DESCENT = 1.5  # m/s², about, of a landing without poses, as the estimate drifts
_SHORTEST_LANDING = 1.2  # s
_LANDING_DEPTH, _BLIND_LANDING_DEPTH = (
    0.05,
    0.5,
)  # m below the floor, where landings end; more without poses, as the height is uncertain
_SETTLE_TIME = 0.5  # s at the end of a descent


def upload_program(loop: FlightLoop, program: OnBoardProgram) -> None:
    """Write the trajectory memory, read it back, and define what it holds. Raises LinkError or PreflightError."""
    loop.history.enter(Phase.UPLOAD)
    held = loop.link.upload_trajectory(program.memory)
    loop.restart_deadlines()
    if held != program.memory:
        wrong = sum(a != b for a, b in zip(held, program.memory, strict=False)) + abs(len(held) - len(program.memory))
        raise PreflightError(
            f"the trajectory memory holds {wrong} other bytes than were uploaded", where="vehicle",
            hint="does another client write to it? Restart the vehicle and try again",
        )  # fmt: skip
    answer = _ask(loop, commands.define(program.pieces, compressed=program.compressed))
    if answer != commands.DONE:
        raise PreflightError(
            f"the vehicle does not define the trajectory: {_answer_text(answer)}", where="vehicle",
            hint="update its firmware, and restart it",
        )  # fmt: skip
    loop.history.add_event(Level.INFO, f"{program.pieces} pieces in {len(program.memory)} bytes uploaded and read back")


def _ask(loop: FlightLoop, command: bytes, sent: Callable[[], object] = lambda: None) -> int | None:
    """Send a command until it is answered, and return the answer; None if there is none.

    `sent` is called at each sending.
    """
    number = command[0]
    for attempt in range(ATTEMPTS):
        loop.link.replies.pop(number, None)
        loop.link.command(command)
        sent()
        loop.until(lambda: number in loop.link.replies, ANSWER_TIMEOUT)
        answer = loop.link.replies.get(number)
        if attempt and answer == commands.BUSY:  # the first one arrived, its answer did not
            return commands.DONE
        if answer is not None:
            return answer
    return None


def _answer_text(answer: int | None) -> str:
    """Return an answer in words."""
    return "it does not answer" if answer is None else commands.ANSWERS.get(answer, f"it answers {answer}")


@dataclass(frozen=True, slots=True)
class _Departure:
    """A command to fly on, until the vehicle is known to have taken it or not."""

    number: int
    sent: float  # s
    begin: Callable[[float], object]  # begins what it flies then, given `sent`


class OnBoardManoeuvres:
    """Lets the vehicle's commander fly a mission's phases."""

    def __init__(self, loop: FlightLoop, floor: float, program: OnBoardProgram):
        self._loop, self._floor, self._program = loop, floor, program  # m, height of the tracked body before take-off
        self._mission, self._limits, self._history = loop.mission, loop.limits, loop.history
        self._stops = list[tuple[float, NDArray]]()  # commanded: s, when sent; (M, 29) uint8, the stop as setpoints
        self._departure: _Departure | None = None
        self._landing = False  # the last descent has begun

    def take_off(self) -> None:
        """Climb to a hover once the watchdog runs. Raises PreflightError if the vehicle stays on the floor."""
        loop, height = self._loop, self._mission.take_off_height
        way, duration = begin_take_off(loop, self._floor, self._way)
        loop.pause(_KEEP_ALIVE_TIME)
        answer = _ask(loop, commands.take_off(height, duration), lambda: loop.begin(way))
        if answer != commands.DONE:
            self._stop_motors()
            loop.touch_down()
            raise PreflightError(
                f"the vehicle does not take off: {_answer_text(answer)}", where="vehicle",
                hint="restart it on a level floor; its console says more",
            )  # fmt: skip
        assert loop.stream is not None
        climb(loop, loop.stream, self._floor, height, self._stop_motors)

    def go_to_start(self) -> None:
        """Fly to where the trajectory begins and wait until the vehicle is there."""
        loop = self._loop
        self._history.enter(Phase.GO_TO_START)
        (x, y, z), _, yaw = loop.setpoint_now()
        start = self._program.begin
        duration = go_to_time(math.dist(loop.pose().position, start[:3]), start[3] - yaw, self._limits)
        way = self._way((x, y, z, yaw), start, duration)
        self._depart(commands.go_to(*start, duration), lambda sent: loop.begin(way, sent), "go to the start")
        assert loop.stream is not None
        end = loop.stream.end
        loop.until(lambda: loop.now() > end, math.inf)
        settle_at(loop, start[:3])

    def fly_plan(self) -> None:
        """Start the trajectory, and watch it until its landing begins."""
        loop = self._loop
        loop.await_clearance(Phase.STREAM)
        self._history.enter(Phase.STREAM)
        self._depart(commands.start(), loop.begin_plan, "start the trajectory")
        self._history.add_event(Level.INFO, "the vehicle flies the trajectory on board")
        loop.until(lambda: loop.now() > loop.plan.start + loop.motion_ends, math.inf)
        self._history.enter(Phase.HOLD)
        loop.until(lambda: loop.now() > loop.plan.end, math.inf)

    def land(self) -> None:
        """Watch the landing with which the trajectory ends, and stop the motors once the vehicle stands."""
        loop = self._loop
        self._begin_landing()
        down = loop.begin(Stream(self._program.descent, self._mission.rate, on_board=True))
        loop.until(lambda: stands_by_poses(loop, self._floor) or loop.now() > down.end + _SETTLE_TIME, math.inf)
        self._end_landing()

    def land_by_setpoints(self) -> None:
        """Stop by setpoints, unless they have stopped it already, and land by them."""
        loop, left = self._loop, self._loop.stream
        loop.doubt_stream(False)
        if left is not None and left.on_board:
            if left.stop_from is None:  # it may not have followed the last descent
                loop.hold_where_it_is()
            else:
                end = loop.begin(Stream(left.stop_from(left.index(loop.now())), self._mission.rate)).end
                loop.until(lambda: loop.now() > end, math.inf)
        self._begin_landing()
        landing = Landing(loop, self._floor)
        landing.begun = True
        landing.land()

    def brake(self) -> None:
        """Brake to a hover, hold it, and land."""
        self._stop()
        if not self._landing:
            self._history.enter(Phase.HOLD)
            self._loop.until(lambda: self._loop.health.poses is GONE, BRAKE_HOLD)
        self._descend()

    def stop_and_land(self) -> None:
        """Brake, and land at once."""
        self._stop()
        self._descend()

    def _depart(self, command: bytes, begin: Callable[[float], object], what: str) -> None:
        """Command the vehicle to fly on from its hover, and `begin` the reference once it has taken the command.

        A command that it has not taken has perished by then, and is sent again. Raises AbortRaised if it refuses.
        """
        loop, number = self._loop, command[0]
        for _ in range(ATTEMPTS):
            loop.link.replies.pop(number, None)
            loop.link.command(command)
            self._departure = _Departure(number, loop.now(), begin)
            loop.doubt_stream(True)
            answer = self._answer_to_departure()
            if answer is not None:
                break
        if answer != commands.DONE:
            raise AbortRaised(AbortReason.COMMAND_FAILED.abort(Rung.LAND, command=what, answer=_answer_text(answer)))

    def _answer_to_departure(self) -> int | None:
        """Wait until the vehicle answers the command to fly on, or its log shows whether it does; begin the reference.

        Returns None if neither shows that it does. An abort may interrupt the wait, which `_stop` resumes.
        """
        loop, departure = self._loop, self._departure
        if departure is None:
            return None

        def answer() -> int | None:
            return loop.link.replies.get(departure.number)

        def logged() -> bool:
            return loop.status is not None and loop.status.time > departure.sent + MAX_AGE

        loop.until(lambda: answer() is not None or logged() or loop.health.status_unknown, math.inf)
        self._departure = None
        loop.doubt_stream(False)
        flies = answer() is None and logged() and not loop.bits(TRAJECTORY_FINISHED)
        if flies or answer() == commands.DONE:
            departure.begin(departure.sent)
            return commands.DONE
        return answer()

    def _way(self, begin: tuple[float, ...], end: tuple[float, ...], duration: float) -> Stream:
        """Return what the commander flies from hover to hover, m and rad, as setpoints, with a stop from each."""
        hover = np.zeros((1, 3, 4))
        hover[0, 0] = begin
        turn = math.remainder(end[3] - begin[3], math.tau)
        states = go_to_states(hover, np.array([[*end[:3], begin[3] + turn]]), duration, self._rows(duration))[0]
        return Stream(
            self._encoded(states), self._mission.rate, stop_from=lambda row: self._stop_rows(states[row]), on_board=True
        )

    def _stop_rows(self, state: np.ndarray) -> np.ndarray:
        """Return the stop from a state of the commander, (5, 4), as setpoints."""
        begin = state[None, :3]
        return self._encoded(go_to_states(begin, stop_targets(begin), STOP_DURATION, self._rows(STOP_DURATION))[0])

    def _rows(self, duration: float) -> int:
        return round(duration * self._mission.rate) + 1

    def _encoded(self, states: np.ndarray) -> np.ndarray:
        motion = motion_of(states, self._limits.airframe)
        return encode_motion(motion, motion.acceleration, gains_under(self._limits), space=self._limits.space)

    def _stop(self) -> None:
        """Let the commander brake to a hover where it was certified to, or finish a stop that has begun."""
        self._answer_to_departure()
        loop, left = self._loop, self._loop.stream
        if left is None or self._landing:
            return
        if left.stop_from is not None:
            self._command_stop(left, left.stop_from)
        end = loop.stream.end if loop.stream is not None else 0.0
        loop.until(lambda: loop.now() > end, math.inf)

    def _command_stop(self, left: Stream, stop_from: Callable[[int], NDArray]) -> None:
        """Command a stop from the present setpoint of `left` until the vehicle answers; setpoints stop it otherwise.

        Until it answers, it flies on along `left`, as does the reference. A stop is commanded only while the vehicle is
        heard, and again only once it has answered a later ping instead: then the command before has perished.
        """
        loop, replies, rate = self._loop, self._loop.link.replies, self._mission.rate
        while not self._stops or commands.GO_TO not in replies:
            if left is loop.plan and loop.now() > left.end:  # it lands by itself
                return
            sent = self._stops[-1][0] if self._stops else -math.inf
            if loop.health.uplink is FRESH and loop.link.acknowledged > sent + MAX_AGE:
                if len(self._stops) == ATTEMPTS:
                    break
                replies.pop(commands.GO_TO, None)  # of the way to the start
                self._stops.append((loop.now(), stop_from(left.index(loop.now()))))
                loop.link.command(_go_to_end_of(self._stops[-1][1]))
            loop.tick()
        sent, rows = self._stops[-1]
        if left is loop.plan:
            self._history.stopped_at = sent
        answer = replies.get(commands.GO_TO)
        if answer == commands.DONE:
            flown = min(round((loop.now() - sent) * rate), len(rows) - 1)
            loop.begin(Stream(rows[flown:], rate, on_board=True))
        else:
            self._history.add_event(
                Level.WARNING, f"the vehicle does not stop: {_answer_text(answer)}; setpoints stop it"
            )
            loop.begin(Stream(stop_from(left.index(loop.now())), rate))

    def _begin_landing(self) -> None:
        if not self._landing:
            self._landing = True
            self._history.enter(Phase.LAND)

    def _descend(self) -> None:
        """Let the commander land from the present setpoint; quickly without poses."""
        loop = self._loop
        if loop.stream is None:  # no take-off was commanded yet
            self._end_landing()
            return
        (x, y, z), _, yaw = loop.setpoint_now()
        self._begin_landing()
        if not loop.stream.on_board:  # setpoints stopped it, and outrank its commander
            self.land_by_setpoints()
            return
        lowest = self._floor - (_BLIND_LANDING_DEPTH if loop.health.poses is GONE else _LANDING_DEPTH)
        way = max(z - lowest, 0.0)
        quick = math.sqrt(7.513 * way / _QUICK_DESCENT)  # the peak of a septic's acceleration is 7.513 way / duration²
        duration = max(quick if loop.health.poses is GONE else way / self._limits.ground.land_speed, _SHORTEST_LANDING)
        down = self._way((x, y, z, yaw), (x, y, min(lowest, z), yaw), duration)
        down.stop_from = None
        answer = _ask(loop, commands.land(lowest, duration), lambda: loop.begin(down))
        if answer not in (commands.DONE, commands.BUSY):  # busy: it lands already
            self._history.add_event(
                Level.WARNING, f"the vehicle does not land: {_answer_text(answer)}; setpoints land it"
            )
            self.land_by_setpoints()
            return
        end = loop.stream.end + _SETTLE_TIME
        loop.until(lambda: stands_by_poses(loop, self._floor) or loop.now() > end, math.inf)
        self._end_landing()

    def _end_landing(self) -> None:
        """Stop the motors. Raises AbortRaised if they do not stop."""
        if not self._stop_motors():
            raise AbortRaised(AbortReason.MOTORS_DO_NOT_STOP.abort(Rung.CUT))
        self._loop.touch_down()

    def _stop_motors(self) -> bool:
        """Stop the motors, and return whether the vehicle confirms it; its null setpoints take over then."""
        return stop_until_confirmed(self._loop, lambda: _ask(self._loop, commands.stop()))


def _go_to_end_of(stop: NDArray) -> bytes:
    """Return the command to fly to where a stop, (M, 29) uint8, ends."""
    last = decode(stop[-1:].reshape(-1, PAYLOAD_SIZE))
    (x, y, z), yaw = last.position[0].tolist(), yaw_of(tuple(last.quaternion[0].tolist()))
    return commands.go_to(x, y, z, yaw, STOP_DURATION)
