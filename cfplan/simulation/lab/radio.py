"""The simulated radio between computer and vehicle: polled, retried until acknowledged, and sometimes dead.

A Crazyradio sends one packet, gets at most one back with the acknowledgement, and repeats both until it has got it
(cflib's safelink). Loss therefore costs time and nothing else, until one side's queue is full: the computer's holds
the packet in the air and one more, the vehicle's 120. What a dead radio held comes out when it returns, and is old;
but setpoints and poses that wait for long do not come: both radios, real and simulated, send from an `Outbox`.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

import numpy as np

from cfplan.errors import InputError
from cfplan.flight.radio.crtp import NULL_PACKET
from cfplan.flight.radio.perishable import Outbox
from cfplan.simulation.timed_fault import TimedFault

TRANSACTION = 0.001  # s a transmission and its acknowledgement: 1,000 a second, as cflib gets
COMPUTER_QUEUE = 2  # packets: the one in the air, and the one that waits behind it
_VEHICLE_QUEUE = 120


class RadioFaultKind(StrEnum):
    """Kinds of faults."""

    LOSS = "loss"  # a share of `size` of the transmissions fails
    DELAY = "delay"  # packets take `size` s longer, either way
    DEAD = "dead"  # none gets through
    UNACKNOWLEDGED = "unacknowledged"  # packets get through, and nothing comes back


@dataclass(frozen=True, slots=True)
class RadioFault(TimedFault):
    """One fault of the radio."""

    kind: RadioFaultKind
    usual: ClassVar[Mapping[StrEnum, float]] = {RadioFaultKind.LOSS: 0.3, RadioFaultKind.DELAY: 0.02}

    def __post_init__(self) -> None:
        TimedFault.__post_init__(self)
        if self.strength < 0.0 or (self.kind is RadioFaultKind.LOSS and self.strength >= 1.0):
            raise InputError(f"{self} is out of range", hint="loss is a share from 0 to less than 1, delay in s")


class Radio:
    """Both directions of a link. The owner advances it with `step`, in s on any clock."""

    def __init__(self, now: float, seed: int = 11):
        self._chance = np.random.default_rng(seed)
        self._next = now
        self._faults: list[tuple[float, float, RadioFault]] = []
        self._now = now  # s, of the last step
        self._outbox = Outbox()
        self._down: deque[bytes] = deque()
        self._on_way_up: deque[tuple[float, bytes]] = deque()
        self._on_way_down: deque[tuple[float, bytes]] = deque()
        self._repeated = False  # the vehicle has the packet in the air, whose acknowledgement was lost
        self.dropped = 0  # packets dropped by a full queue

    def inject(self, fault: RadioFault, now: float) -> None:
        """Let something go wrong; its start counts from now."""
        self._faults.append((now + fault.start, now + fault.start + fault.duration, fault))

    @property
    def full(self) -> bool:
        """Return whether the computer's side takes no more packet now."""
        return self._outbox.full(self._now)

    @property
    def busy(self) -> bool:
        """Return whether any packet is on its way."""
        return bool(not self._outbox.empty or self._down or self._on_way_up or self._on_way_down)

    def send(self, packet: bytes) -> None:
        """Send a packet from the computer; it is dropped if there is no room."""
        if not self._outbox.put(packet, self._now):
            self.dropped += 1

    def answer(self, packet: bytes) -> None:
        """Send a packet from the vehicle; it is dropped if the queue is full."""
        if len(self._down) >= _VEHICLE_QUEUE:
            self.dropped += 1
        else:
            self._down.append(packet)

    def step(self, now: float) -> tuple[list[bytes], list[bytes]]:
        """Return the packets that have reached the vehicle by now, and those that have reached the computer."""
        self._now = max(self._now, now)
        if self._outbox.empty and not self._down:
            if now > self._next:
                self._next = now
                self._transact(now)  # an empty packet, as cflib sends if there is nothing else
            if not (self._on_way_up or self._on_way_down):
                return [], []
        while self._next <= now and (not self._outbox.empty or self._down):
            self._transact(self._next)
            self._next += TRANSACTION
        return _arrived(self._on_way_up, now), _arrived(self._on_way_down, now)

    def _transact(self, time: float) -> None:
        due, silent = time, False
        if self._faults:
            if self._acting(RadioFaultKind.DEAD, time) is not None:
                return
            loss, delay = self._acting(RadioFaultKind.LOSS, time), self._acting(RadioFaultKind.DELAY, time)
            if loss is not None and self._chance.random() < loss.strength:
                return
            due += delay.strength if delay is not None else 0.0
            silent = self._acting(RadioFaultKind.UNACKNOWLEDGED, time) is not None
        if not self._outbox.empty:
            packet = self._outbox.transmission(time)
            if not self._repeated and packet != NULL_PACKET:
                self._on_way_up.append((due, packet))
            self._repeated = silent  # the vehicle takes a repeated packet once
            if not silent:
                self._outbox.acknowledged()
        if silent:
            return
        if self._down:
            self._on_way_down.append((due, self._down.popleft()))

    def _acting(self, kind: RadioFaultKind, time: float) -> RadioFault | None:
        for begin, end, fault in self._faults:
            if fault.kind is kind and begin <= time < end:
                return fault
        return None


def _arrived(way: deque[tuple[float, bytes]], now: float) -> list[bytes]:
    found = []
    while way and way[0][0] <= now:
        found.append(way.popleft()[1])
    return found
