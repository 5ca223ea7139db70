"""Streamed manoeuvres: from lift-off to the floor the vehicle is flown by setpoints only.

The firmware has time-outs for setpoints, but none for its on-board commander.
"""

import math

import numpy as np

from cfplan.flight.pilot.flight_loop import FlightLoop
from cfplan.flight.pilot.health import Descent
from cfplan.flight.pilot.landing import Landing, stop_motors
from cfplan.flight.pilot.manoeuvres import Place, begin_take_off, climb, settle_at
from cfplan.flight.pilot.mission import go_to_time
from cfplan.flight.pilot.proposals import NEXT_PART_TIMEOUT
from cfplan.flight.pilot.stream import Stream
from cfplan.flight.setpoints.encoding import encode_motion
from cfplan.flight.setpoints.hover_to_hover import hover_to_hover
from cfplan.flight.setpoints.rate_trade import ahead, gains_under
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.flight.telemetry import Level, Phase

BRAKE_HOLD = 1.0  # s of hover after a stop
_FOLLOWS_WITHIN = 0.15  # m from its setpoint; a vehicle farther away stops from the nearest setpoint


class StreamedManoeuvres:
    """Flies a mission's phases by setpoints."""

    def __init__(self, loop: FlightLoop, floor: float):
        self._loop, self._floor = loop, floor  # m, height of the tracked body before take-off
        self._mission, self._limits, self._history = loop.mission, loop.limits, loop.history
        self._landing = Landing(loop, floor)

    def take_off(self) -> None:
        """Climb by setpoints. Raises PreflightError where the vehicle stays on the floor."""
        loop = self._loop
        way, _ = begin_take_off(loop, self._floor, self._way)
        climb(loop, loop.begin(way), self._floor, self._mission.take_off_height, lambda: stop_motors(loop))

    def _way(self, begin: Place, end: Place, duration: float) -> Stream:
        """Return setpoints from hover to hover, with a stop from each."""
        rate = self._mission.rate
        motion = hover_to_hover(begin[:3], begin[3], end[:3], end[3], duration, rate)
        gains, space = gains_under(self._limits), self._limits.space
        payloads = encode_motion(motion, ahead(motion.acceleration, rate), gains, space=space)
        return Stream(
            payloads,
            rate,
            stop_from=lambda row: encode_stops(motion, rate, rows=np.array([row]), gains=gains, space=space)[0],
        )

    def go_to_start(self) -> None:
        """Fly to the plan's first setpoint and wait until the vehicle is there."""
        loop = self._loop
        self._history.enter(Phase.GO_TO_START)
        start, yaw = self._mission.start
        (x, y, z), _, yaw_above = loop.setpoint_now()
        duration = go_to_time(math.dist(loop.pose().position, start), yaw - yaw_above, self._limits)
        way = loop.begin(self._way((x, y, z, yaw_above), (*start, yaw), duration))
        loop.until(lambda: loop.now() > way.end, math.inf)
        settle_at(loop, start)

    def fly_plan(self) -> None:
        """Stream the plan, then hover for the mission's hold time; a new plan that arrives meanwhile is flown too."""
        loop = self._loop
        loop.await_clearance(Phase.STREAM)
        skipped = loop.skipped
        loop.begin_plan()
        while True:
            self._history.enter(Phase.STREAM)
            loop.until(lambda: loop.now() > loop.plan.end, math.inf)
            self._history.skipped = loop.skipped - skipped
            self._history.enter(Phase.HOLD)
            if not loop.until(lambda: self._finished() or loop.now() < loop.plan.end, self._mission.hold_time):
                break
            if self._finished():
                break
        if loop.commitment.unfinished:
            self._history.add_event(Level.WARNING, "the next part of the plan did not come: landing before its end")

    def _finished(self) -> bool:
        """Return whether the vehicle is to land here: it is finishing, and no next part of its plan is awaited."""
        loop = self._loop
        awaited = NEXT_PART_TIMEOUT if loop.commitment.unfinished else 0.0
        return loop.finishing and loop.now() >= loop.plan.end + awaited

    def land(self) -> None:
        """Land by setpoints, and stop the motors."""
        self._landing.land()

    def land_by_setpoints(self) -> None:
        """Land, as always, by setpoints."""
        self._landing.land()

    def brake(self) -> None:
        """Brake to a hover along the plan, hold it, and land."""
        loop = self._loop
        self._stop()
        if not (self._landing.begun or loop.descent is Descent.HELD):
            self._history.enter(Phase.HOLD)
            loop.until(lambda: loop.descent is Descent.HELD, BRAKE_HOLD)
        self._landing.land()

    def stop_and_land(self) -> None:
        """Brake, and land at once."""
        self._stop()
        self._landing.land()

    def _stop(self) -> None:
        """Brake along the path to a hover, or finish a stop that has begun; if poses are gone, also sink.

        A vehicle that was without setpoints is no longer on its path, and one with distrusted poses never was.
        """
        loop, left = self._loop, self._loop.stream
        if left is None or self._landing.begun or loop.descent is Descent.HELD or loop.tracker.distrusted:
            return
        if left.stop_from is not None:
            stop = left.stop_from(self._present_index(left))
            started = loop.begin(Stream(stop, self._mission.rate))
            if left is loop.plan:
                self._history.stopped_at = started.start
        end = loop.stream.end if loop.stream is not None else 0.0
        loop.until(lambda: loop.now() > end or loop.descent is not Descent.BY_POSES, math.inf)
        if loop.now() < end and loop.descent is Descent.BLIND:
            self._landing.sink_while_stopping()
            loop.until(lambda: loop.now() > end or loop.descent is Descent.HELD, math.inf)

    def _present_index(self, stream: Stream) -> int:
        """Return the setpoint to stop from: the present one, or the nearest before it if the vehicle fell behind."""
        loop = self._loop
        due = stream.index(loop.now())
        pose = loop.pose()
        if loop.now() - pose.time > self._limits.pose.age_warning:
            return due
        setpoint_position = loop.setpoint_position(pose.time)
        if setpoint_position is None or math.dist(pose.position, setpoint_position) < _FOLLOWS_WITHIN:
            return due
        nearest, least = due, math.inf
        for index in range(due, stream.first - 1, -1):
            distance = math.dist(pose.position, stream.state(index)[0])
            if distance < least:
                nearest, least = index, distance
            elif distance > least + _FOLLOWS_WITHIN:  # a distance that falls again belongs to another turn of the path
                break
        return nearest
