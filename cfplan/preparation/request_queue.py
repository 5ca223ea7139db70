"""Requests to change the path in flight, as the planner's process takes them from the main process."""

import math
from multiprocessing.connection import Connection

from cfplan.flight.clock import Clock
from cfplan.preparation.air_planner import PathAnswer, PathRequest, PathVerdict


class RequestQueue:
    """The requests of the main process, of which only the latest waits, and the answers to them."""

    def __init__(self, connection: Connection, clock: Clock):
        self.connection, self._clock = connection, clock
        self.waiting: tuple[PathRequest, float] | None = None  # and when it came, s
        self.asked = -math.inf  # s, when the last request came
        self._newest = 0  # number of that

    def receive(self) -> None:
        """Take the next request, which has come; the one that waits for it is superseded."""
        request = self.connection.recv()
        if self.waiting is not None:
            self.tell(PathAnswer(self.waiting[0].number, PathVerdict.SUPERSEDED))
        self.asked, self._newest = self._clock.now(), request.number
        self.waiting = request, self.asked

    def take(self) -> tuple[PathRequest, float]:
        """Return the request that waits, and when it came, s; it waits no more."""
        assert self.waiting is not None
        taken, self.waiting = self.waiting, None
        return taken

    def wait_again(self, request: PathRequest, came: float) -> bool:
        """Let a request wait that was taken; return whether it does: not where another has come since."""
        latest = request.number == self._newest
        if latest:
            self.waiting = request, came
        return latest

    def tell(self, answer: PathAnswer) -> None:
        """Send an answer to the main process."""
        self.connection.send(answer)
