"""The core of planning in the air: whatever comes in whatever order, requests are answered, and both sides agree."""

import math
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cfplan.air.core import (
    NO_ANSWER,
    NO_NEXT_PART,
    NOT_FLOWN,
    PILOT_ANSWER_TIMEOUT,
    Answered,
    Asked,
    Begun,
    Made,
    Make,
    Propose,
    Tell,
    first_state,
    step,
)
from cfplan.air.requests import PathRequest, PathVerdict, Wish
from cfplan.air.timeline import Replanned, hold_hover
from cfplan.flight.pilot.proposals import NEXT_PART_TIMEOUT
from cfplan.flight.setpoints.commitment import Fault, propose, spliced
from cfplan.flight.setpoints.encoding import RATE

PLAN, STOP = 0.05, 0.02  # s
FINAL = {PathVerdict.ACCEPTED, PathVerdict.REFUSED, PathVerdict.LATE, PathVerdict.SUPERSEDED}


@pytest.fixture(scope="module")
def hovering(limits):
    return hold_hover((0.0, 0.0, 0.8), 0.0, limits)


def hover_on(timeline, splice):
    """Return the proposal to hover on from a setpoint, as a plan would be proposed."""
    payloads, stops = timeline.commitment.payloads[-30:], timeline.commitment.stops[-30:]
    proposal = propose(timeline.commitment, splice, payloads, stops)
    return Replanned(proposal, replace(timeline, begin=min(timeline.begin, splice)), None, splice / RATE)


class Flight:
    """The core, a planner that hovers on, and a pilot that is committed to what it accepts."""

    def __init__(self, timeline, limits):
        self.limits, self.now = limits, 10.0
        self.state, self.pilot = first_state(timeline, PLAN, STOP), timeline.commitment
        self.jobs, self.proposals, self.told = [], [], []
        self.asked = 0

    def take(self, *events) -> None:
        self.state, effects = step(self.state, events, self.now, self.limits)
        for effect in effects:
            match effect:
                case Make(job):
                    self.jobs.append(job)
                case Propose(proposal):
                    self.proposals.append(proposal)
                case Tell(answer):
                    self.told.append(answer)

    def begin(self) -> None:
        self.take(Begun(self.now))

    def ask(self, wish=Wish.REPLACE) -> int:
        self.asked += 1
        self.take(Asked(PathRequest(self.asked, wish, ((0.5, 0.5, 1.0),))))
        return self.asked

    def make(self, result=None) -> None:
        """Finish the job under way."""
        job = self.jobs.pop()
        self.take(Made(job, hover_on(self.state.timeline, job.splice) if result is None else result))

    def answer(self, reason="") -> None:
        """Let the pilot accept the proposal that it has, or refuse it for a reason."""
        proposal = self.proposals.pop()
        if not reason:
            assert proposal.follows == self.pilot.checksum
            due = math.floor((self.now - self.state.begun) * RATE)
            self.pilot = spliced(self.pilot, proposal, min(due, proposal.splice))
        self.take(Answered(proposal.checksum, None if reason else self.pilot.checksum, self.now, reason))

    def final(self) -> Counter:
        return Counter(answer.number for answer in self.told if answer.verdict in FINAL)


@pytest.fixture
def flight(hovering, limits):
    made = Flight(hovering, limits)
    made.begin()
    return made


def test_a_request_is_planned_proposed_and_accepted(flight):
    number = flight.ask()
    flight.now += 0.03
    flight.make()
    flight.answer()
    (answer,) = flight.told
    assert (answer.number, answer.verdict) == (number, PathVerdict.ACCEPTED)
    assert answer.seconds == pytest.approx(0.03)
    assert flight.state.timeline.commitment.checksum == flight.pilot.checksum


def test_before_the_flight_has_begun_requests_are_refused(hovering, limits):
    flight = Flight(hovering, limits)
    flight.ask()
    assert [answer.reason for answer in flight.told] == [NOT_FLOWN]


def test_the_latest_request_wins(flight):
    numbers = [flight.ask() for _ in range(4)]
    verdicts = {answer.number: answer.verdict for answer in flight.told}
    assert verdicts == dict.fromkeys(numbers[1:3], PathVerdict.SUPERSEDED)
    for _ in range(2):
        flight.make()
        flight.answer()
    assert flight.told[-1].number == numbers[-1]
    assert flight.told[-1].verdict is PathVerdict.ACCEPTED


@pytest.mark.parametrize("by", ["the clock", "the pilot"])
def test_what_comes_too_late_is_made_again_from_farther_ahead(flight, by):
    number = flight.ask()
    first = flight.jobs[0].splice - (flight.now - flight.state.begun) * RATE
    if by == "the clock":
        flight.now += 2.0 * PLAN
        flight.make()
    else:
        flight.make()
        flight.answer(f"{Fault.LATE}: for setpoint 3, with 4 due")
    assert not flight.told
    again = flight.jobs[0].splice - (flight.now - flight.state.begun) * RATE
    assert again > 1.8 * first
    while flight.jobs:
        flight.now += 2.0 * flight.jobs[0].ahead
        flight.make()
    assert [(answer.number, answer.verdict) for answer in flight.told] == [(number, PathVerdict.LATE)]


def test_a_refusal_leaves_the_timeline_and_gives_the_reason(flight):
    before = flight.state.timeline
    flight.ask()
    flight.make("no way leads there")
    flight.ask()
    flight.make()
    flight.answer("the proposal leaves the space")
    assert [answer.reason for answer in flight.told] == ["no way leads there", "the proposal leaves the space"]
    assert flight.state.timeline is before


def test_while_the_pilot_does_not_answer_requests_are_refused_and_what_it_accepts_at_last_is_flown(flight):
    first = flight.ask()
    flight.make()
    flight.now += PILOT_ANSWER_TIMEOUT
    second = flight.ask()
    assert {answer.number: answer.reason for answer in flight.told} == {first: NO_ANSWER, second: NO_ANSWER}
    assert not flight.jobs
    flight.answer()
    assert (flight.told[-1].number, flight.told[-1].verdict) == (first, PathVerdict.ACCEPTED)
    flight.ask()
    flight.make()
    flight.answer()
    assert flight.told[-1].verdict is PathVerdict.ACCEPTED


def test_a_plan_whose_next_part_never_comes_in_time_is_cut_short_before_a_finishing_pilot_lands(flight):
    left = replace(flight.state.timeline, left=np.array([[0.5, 0.5, 1.0]]))
    flight.state = replace(flight.state, timeline=left, accepted=7)
    rests = flight.now + left.commitment.last / RATE
    flight.take()
    while flight.now < rests + NEXT_PART_TIMEOUT:
        assert not flight.told
        flight.now += 0.1
        flight.make()
        if flight.proposals:
            flight.answer(Fault.LATE.value)
    assert [(answer.number, answer.verdict, answer.reason) for answer in flight.told] == [
        (7, PathVerdict.CUT_SHORT, NO_NEXT_PART)
    ]
    assert not flight.state.timeline.unfinished


def test_how_far_ahead_is_planned_follows_how_long_plans_took(flight):
    def ahead() -> float:
        flight.ask()
        found = flight.jobs[0].splice / RATE - (flight.now - flight.state.begun)
        flight.now += 0.2
        flight.make("not this one")
        return found

    for _ in range(30):
        flight.ask()
        flight.now += 0.019
        flight.make()
        flight.answer()
    assert ahead() < PLAN
    for _ in range(30):
        flight.ask()
        flight.now += 0.039
        flight.make()  # the first come too late, and are made once more
        if flight.jobs:
            flight.make()
        flight.answer()
    assert 0.039 < ahead() < 0.065


def test_a_fault_in_planning_is_an_answer(flight, limits):
    flight.ask()
    job = replace(flight.jobs.pop(), request=PathRequest(1, Wish.REPLACE, ("no", "numbers")))
    flight.take(job.outcome(flight.state.timeline, limits))
    (answer,) = flight.told
    assert answer.verdict is PathVerdict.REFUSED
    assert "fault in the planner: ValueError" in answer.reason


ACTS = st.sampled_from(["ask", "stop", "time", "long", "make", "fail", "nothing", "accept", "refuse", "late"])


@settings(max_examples=200, deadline=None)
@given(acts=st.lists(ACTS, max_size=40))
def test_in_any_order_each_request_is_answered_once_and_both_sides_agree(hovering, limits, acts):
    """But where the pilot did not answer in time: then a request that was refused may be flown after all."""
    flight = Flight(hovering, limits)
    flight.begin()
    for act in acts:
        match act:
            case "ask":
                flight.ask()
            case "stop":
                flight.ask(Wish.STOP)
            case "time":
                flight.now += 0.01
                flight.take()
            case "long":
                flight.now += 0.7
                flight.take()
            case "make" if flight.jobs:
                flight.make()
            case "fail" if flight.jobs:
                flight.make("no way leads there")
            case "nothing" if flight.jobs:
                flight.make(flight.state.timeline)
            case "accept" if flight.proposals:
                flight.answer()
            case "refuse" if flight.proposals:
                flight.answer("the proposal leaves the space")
            case "late" if flight.proposals:
                flight.answer(Fault.LATE.value)
        assert len(flight.jobs) + len(flight.proposals) <= 1
    while flight.jobs or flight.proposals:
        if flight.jobs:
            flight.make("no way leads there")
        if flight.proposals:
            flight.answer()
    assert flight.state.timeline.commitment.checksum == flight.pilot.checksum
    excused = {answer.number for answer in flight.told if answer.reason == NO_ANSWER}
    for number in range(1, flight.asked + 1):
        assert flight.final()[number] == 1 or (number in excused and flight.final()[number] == 2), flight.told
