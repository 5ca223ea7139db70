"""The stepped lab, without real time: vehicle, radio and cameras on a clock that runs only while the pilot sleeps.

It has the same virtual Crazyflie, packets, pose tracker and pilot as a lab of processes, in one thread: every
flight can be repeated to the last bit, and takes a fraction of its time.
"""

import math
from collections.abc import Callable

import numpy as np

from cfplan.flight.clock import BEGIN, SteppedClock
from cfplan.simulation.lab.lab import MOTORS, OFF_IN_AIR, ROW_SIZE, STATE, SUPERVISOR, TIME, Fault, Truth
from cfplan.simulation.lab.radio import Radio, RadioFault
from cfplan.simulation.virtual_crazyflie.faults import VehicleFault
from cfplan.simulation.virtual_crazyflie.settings import VehicleSettings
from cfplan.simulation.virtual_crazyflie.vehicle import PERIOD, VirtualCrazyflie
from cfplan.simulation.virtual_vicon.cameras import Cameras, ViconSettings
from cfplan.simulation.virtual_vicon.server import Picture
from cfplan.vehicle.airframe import Airframe

_WARM_UP = 200  # ms
_RECONNECTS_AFTER = 0.3  # s after the cameras' connection is possible again


class SteppedLab:
    """A stepped lab: `clock` is the pilot's too, `heard` is called with each packet from the vehicle."""

    def __init__(
        self,
        airframe: Airframe,
        *,
        vehicle: VehicleSettings | None = None,
        cameras: ViconSettings | None = None,
        seed: int = 0,
    ):
        self.vehicle = VirtualCrazyflie(airframe, vehicle)
        self.vehicle.advance(_WARM_UP)
        self.vehicle.sent()
        self.clock = SteppedClock(BEGIN, self._advance)
        self.radio = Radio(BEGIN, seed=11 + seed)
        self.cameras = Cameras(cameras or ViconSettings(seed=7 + seed), BEGIN)
        self.heard: Callable[[bytes], None] = lambda _: None
        self._origin = BEGIN - self.vehicle.tick / 1000
        self._pictures: list[tuple[float, Picture]] = []
        self._connected_from = BEGIN
        self._rows: list[np.ndarray] = []

    @property
    def now(self) -> float:
        """Return the time, s."""
        return self.clock.now()

    def disturb(self, fault: Fault) -> None:
        """Let something go wrong; its start counts from now."""
        if isinstance(fault, VehicleFault):
            self.vehicle.inject(fault)
        elif isinstance(fault, RadioFault):
            self.radio.inject(fault, self.now)
        else:
            self.cameras.inject(fault, self.now)

    def pictures(self) -> list[tuple[float, Picture]]:
        """Return what the cameras sent since the last call, each with the time at which it came."""
        found, self._pictures = self._pictures, []
        return found

    def truth(self) -> Truth:
        """Return the truth so far."""
        rows = np.array(self._rows).reshape(-1, ROW_SIZE)
        return Truth.of(rows, self.vehicle.locked)

    def _advance(self, end: float) -> None:
        """Advance the lab by milliseconds, from one event to the next."""
        target = int((end - self._origin) * 1000 + 1e-6)
        while (tick := self.vehicle.tick) < target:
            self.clock.reach(self._origin + tick / 1000)
            now, passed = self.clock.now(), tick % PERIOD
            self._exchange(now)
            self._look(now)
            if not passed:
                self._note()
            # At a boundary the vehicle may send logs, which leave within a millisecond, as a real one's do.
            if not passed or self.radio.busy:
                self._run_to(tick + 1)
            else:
                self._run_to(max(min(target, tick + PERIOD - passed, self._next_sight()), tick + 1))
        self.clock.reach(end)
        self._exchange(self.clock.now())

    def _run_to(self, tick: int) -> None:
        """Advance the vehicle to a tick, or to the end of an earlier one in which it sends."""
        while self.vehicle.tick < tick:
            self.vehicle.step()
            if self._answer():
                return

    def _next_sight(self) -> int:
        """Return the tick at which the cameras look or a picture leaves next."""
        then = min(self.cameras.next_look, self.cameras.next_due)
        return math.ceil((then - self._origin) * 1000 - 1e-6)

    def _exchange(self, now: float) -> None:
        up, down = self.radio.step(now)
        for packet in up:
            self.vehicle.receive(packet)
        if up:
            self._answer()
        for packet in down:
            self.heard(packet)

    def _answer(self) -> bool:
        """Give the radio what the vehicle sends; return whether there was anything."""
        packets = self.vehicle.sent()
        for packet in packets:
            self.radio.answer(packet)
        return bool(packets)

    def _look(self, now: float) -> None:
        cameras = self.cameras
        if now < cameras.next_look - 1e-6 and now < cameras.next_due and not cameras.disturbed:
            return
        if now >= cameras.next_look - 1e-6:
            truth = self.vehicle.truth.tolist()
            cameras.look(now, (truth[0], truth[1], truth[2]), (truth[6], truth[7], truth[8], truth[9]))
        due = cameras.due(now) if cameras.next_due <= now else ()
        if cameras.cut_off(now):
            self._connected_from = now + _RECONNECTS_AFTER
        elif due and now >= self._connected_from:
            self._pictures += [(now, picture) for picture in due]

    def _note(self) -> None:
        row, vehicle = np.empty(ROW_SIZE), self.vehicle
        row[TIME], row[STATE], row[MOTORS] = self.now, vehicle.truth, vehicle.motors
        row[OFF_IN_AIR], row[SUPERVISOR] = vehicle.off_in_air, vehicle.supervisor_state
        self._rows.append(row)
