"""Threads of the main process in a steered flight: none of them fails silently."""

import pickle
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from unittest.mock import Mock

import pytest
from waiting import PATIENCE, until

from cfplan.air.requests import PathAnswer, PathVerdict, Wish
from cfplan.errors import CfplanError
from cfplan.flight.pilot.keys import Order
from cfplan.preparation.steps import ignore_steps
from cfplan.steering import real_time_steering
from cfplan.steering.flight_in_progress import Listeners
from cfplan.steering.real_time_steering import RealTimeSteering


def cannot_be_read():
    raise pickle.UnpicklingError("truncated")


def cannot_be_heard(_):
    raise ZeroDivisionError


def fly_until_an_order(*_, more_orders, **__):
    given = []
    assert until(lambda: given.extend(more_orders()) or given)
    return given


def test_a_program_whose_main_thread_has_ended_lands_its_vehicle(monkeypatch):
    monkeypatch.setattr(real_time_steering, "StartingVehicle", lambda *_: nullcontext(Mock()))
    monkeypatch.setattr(
        real_time_steering, "AirPlanner", lambda *_: nullcontext(Mock(ready=True, answers=lambda _: []))
    )
    monkeypatch.setattr(real_time_steering, "fly", fly_until_an_order)
    flight = RealTimeSteering("sim://0", None, Mock(), ignore_steps, keys=False)
    monkeypatch.setattr(threading, "main_thread", lambda: Mock(is_alive=lambda: False))
    flight.start(Mock(), Mock(), Listeners(lambda _: None, lambda _: None))
    assert until(lambda: flight.outcome is not None)
    flight.close()
    assert flight.outcome == [Order.LAND]


@pytest.mark.parametrize(
    ("answers", "listen", "fault"),
    [
        (cannot_be_read, lambda _: None, "UnpicklingError"),
        (lambda: [PathAnswer(1, PathVerdict.REFUSED)], cannot_be_heard, "ZeroDivisionError"),
    ],
)
def test_a_fault_in_hearing_the_planner_lands_the_vehicle_and_is_said(monkeypatch, answers, listen, fault):
    planner = Mock(ready=True, alive=True, answers=lambda _: answers())

    monkeypatch.setattr(real_time_steering, "StartingVehicle", lambda *_: nullcontext(Mock()))
    monkeypatch.setattr(real_time_steering, "AirPlanner", lambda *_: nullcontext(planner))
    monkeypatch.setattr(real_time_steering, "fly", fly_until_an_order)
    flight = RealTimeSteering("sim://0", None, Mock(), ignore_steps, keys=False)
    flight.start(Mock(), Mock(), Listeners(lambda _: None, listen))
    assert until(lambda: flight.outcome is not None)
    flight.close()
    assert isinstance(flight.outcome, CfplanError)
    assert fault in str(flight.outcome)


def test_answers_and_telemetry_are_heard_while_a_request_waits_for_the_planner(monkeypatch):
    read = threading.Event()  # by the planner
    heard: list[object] = []

    def request(*_) -> int:
        assert read.wait(PATIENCE)
        return 7

    def fly(*_, on_telemetry, **__):
        assert until(lambda: heard)  # an answer, so the request waits
        on_telemetry("pose")
        assert until(lambda: read.is_set())

    planner = Mock(ready=True, alive=True, request=request, answers=lambda _: [PathAnswer(1, PathVerdict.REFUSED)])
    monkeypatch.setattr(real_time_steering, "StartingVehicle", lambda *_: nullcontext(Mock()))
    monkeypatch.setattr(real_time_steering, "AirPlanner", lambda *_: nullcontext(planner))
    monkeypatch.setattr(real_time_steering, "fly", fly)
    flight = RealTimeSteering("sim://0", None, Mock(), ignore_steps, keys=False)
    flight.planner = planner
    with ThreadPoolExecutor(1) as program:
        asked = program.submit(flight.ask, Wish.STOP, ())
        flight.start(Mock(), Mock(), Listeners(heard.append, heard.append))
        assert until(lambda: "pose" in heard)
        assert not asked.done()
        read.set()
        assert asked.result(PATIENCE) == 7
    flight.close()
