"""The record of a steered flight: begun before take-off, with every plan committed in the air."""

import json
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from cfplan.air.requests import PathAnswer, PathRequest, PathVerdict, Wish
from cfplan.errors import CfplanError
from cfplan.flight.clock import REAL_CLOCK, Clock
from cfplan.flight.pilot.outcome import FlightOutcome
from cfplan.flight.telemetry import Event, Level, PathAnswered, PathRequested, Telemetry, Triple
from cfplan.identification.advice import suggests_identification
from cfplan.numbers import coordinates
from cfplan.planning.plan_file import save_plan
from cfplan.recording.header import RecordHeader, header_of_steering
from cfplan.recording.reader import read_record
from cfplan.recording.record import PLAN_IN_FLIGHT, Record
from cfplan.recording.summary import summarise
from cfplan.recording.writer import RecordWriter, new_record_folder, wall_time_at_zero, write_summary
from cfplan.safety.limits import Limits


class SteeringRecord:
    """Writes what happens in a steered flight, and tells listeners of it; `tell` takes messages of any thread."""

    def __init__(
        self,
        root: Path,
        name: str,
        uri: str,
        limits: Limits,
        place: Triple,
        yaw: float,
        *,
        clock: Clock = REAL_CLOCK,
    ):
        """Open a new folder under `root`; the flight begins in hover at a place, m, and yaw, rad. Raises InputError."""
        self.folder = new_record_folder(root, name)
        self.header: RecordHeader = header_of_steering(
            limits, name=name, uri=uri, place=place, yaw=yaw, wall_time_at_zero=wall_time_at_zero()
        )
        self._clock, self._uri = clock, uri
        self._writer = RecordWriter(self.folder, self.header, warn=lambda _: None, clock=clock)
        self._summary_failure = ""
        self.listeners: list[Callable[[Telemetry], None]] = []

    def tell(self, message: Telemetry) -> None:
        """Take a message of the flight."""
        self._writer.write(message)
        for listener in self.listeners:
            listener(message)

    def requested(self, request: PathRequest) -> None:
        """Note a request."""
        now = self._clock.now()
        self.tell(PathRequested(now, request.number, request.wish.value, json.dumps(request.waypoints)))
        self.tell(Event(now, Level.INFO, f"request {request.number}: {described(request.wish, request.waypoints)}"))

    def answered(self, answer: PathAnswer) -> None:
        """Note an answer, and keep the plan behind it. A write error shows in `failure`."""
        now = self._clock.now()
        self.tell(
            PathAnswered(
                now, answer.number, answer.verdict.value, answer.reason, answer.splice, answer.joint, answer.ends,
                answer.seconds,
            )
        )  # fmt: skip
        level = Level.INFO if answer.verdict in (PathVerdict.ACCEPTED, PathVerdict.CHANGED) else Level.WARNING
        self.tell(Event(now, level, f"answer {answer.number}: {answer_text(answer)}"))
        if answer.plan is not None:
            with suppress(CfplanError):  # `cfplan check` reports it as missing
                made_for = {"request": str(answer.number), "joint": repr(answer.joint), "splice": str(answer.splice)}
                save_plan(answer.plan, self.folder / PLAN_IN_FLIGHT.format(answer.checksum), made_for)

    @property
    def failure(self) -> str:
        """Return why something could not be written, one line; empty if nothing failed."""
        return self._writer.failure or self._summary_failure

    def close(self, outcome: FlightOutcome | None) -> tuple[Record, dict[str, Any]] | None:
        """End the record; return it and its summary if there was a flight."""
        self._writer.close()
        if outcome is None:
            return None
        record = read_record(self.folder)
        summary = {"uri": self._uri, "outcome": outcome.to_dict(), **summarise(record).to_json()}
        summary["deviation_grows_with_speed"] = suggests_identification(record)
        try:
            write_summary(self.folder, summary)
        except OSError as error:  # as on a full disk; the outcome is reported all the same
            self._summary_failure = f"the summary: {error}"
        return record, summary


def described(wish: Wish, waypoints: tuple[Triple, ...]) -> str:
    """Describe a request in one line."""
    places = ", ".join(coordinates(waypoint, ".2f") for waypoint in waypoints)
    match wish:
        case Wish.EXTEND:
            return f"fly on through {places}"
        case Wish.REPLACE:
            return f"fly through {places} instead"
    return wish.value


def answer_text(answer: PathAnswer) -> str:
    """Describe the answer to a request in one line."""
    if answer.verdict not in (PathVerdict.ACCEPTED, PathVerdict.CHANGED):
        return f"{answer.verdict.value}: {answer.reason}" if answer.reason else answer.verdict.value
    if answer.splice < 0:
        return f"accepted: {answer.reason or 'the next request is flown so'}"
    begins = f"from {answer.joint:.2f} s on{', after a stop' if answer.stop else ''}"
    return f"{answer.verdict.value}: another motion {begins}, at rest at {answer.ends:.2f} s"
