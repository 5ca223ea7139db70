"""Finds out which compiled functions a flight calls, and with which types of arguments, by a small flight in Python."""

import pickle
from contextlib import suppress
from dataclasses import replace
from enum import IntEnum
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cfplan.machine_code import Call

NODES = 12  # grid intervals; so few that plain Python is quick


class Stage(IntEnum):
    """How far a command goes on the way from a path file to a flight."""

    PLAN = 1
    REHEARSAL = 2
    FLIGHT = 3


def find_calls(safety_file: Path, last: Stage) -> "list[Call]":
    """Return the calls of a small flight under these limits, up to a stage, in order; noted once a machine.

    For a process that has not yet imported what plans and flies.
    """
    from cfplan.machine_code import kept_or_made

    title = f"calls-{last.name.lower()}"
    return pickle.loads(kept_or_made(title, __name__, lambda: pickle.dumps(_fly(safety_file, last))))


def _fly(safety_file: Path, last: Stage) -> "list[Call]":
    from cfplan.machine_code import noted_calls

    with noted_calls() as calls:
        import numpy as np

        from cfplan.errors import CfplanError
        from cfplan.flight.setpoints.encoding import RATE, encode_trajectory
        from cfplan.flight.setpoints.rate_trade import gains_under
        from cfplan.flight.setpoints.stops import encode_stops
        from cfplan.geometry.min_snap import min_snap
        from cfplan.learning.model_files import find_model
        from cfplan.planning.plan import plan
        from cfplan.safety.limits_file import load_limits
        from cfplan.simulation.glitches import glitch_at_sampled_setpoints
        from cfplan.simulation.link_loss import link_loss_near_walls, link_loss_within_stops

        limits = load_limits(safety_file)
        limits = replace(limits, space=replace(limits.space, obstacles=()))  # one may stand in the middle
        middle = (np.array(limits.space.low) + limits.space.high) / 2
        places = np.array([[-1.0, -1.0, -0.5], [1.0, 0.0, 0.0], [1.0, 1.0, 0.5]])  # three, so that something is solved
        path = min_snap(middle + 0.2 * places)
        path.check()
        with suppress(CfplanError):  # there may be no model for this vehicle
            model = find_model(limits.airframe, limits.plan)
            nodes = 1 + (model.window if model else NODES)  # more than a network is asked for: it is laid over these
            plan(path, limits.airframe, limits, planner="learned", nodes=nodes)
        planned = plan(path, limits.airframe, limits, planner="expert", nodes=NODES)  # exceeds limits between nodes
        encoded = encode_trajectory(planned.trajectory, gains=gains_under(limits), space=limits.space)
        begin, first = encoded.payloads[:2], np.array([0])
        lost = link_loss_near_walls(begin, limits, 0.0)
        stop = encode_stops(encoded.motion, RATE, rows=first, gains=encoded.gains, space=encoded.space)
        end = np.arange(stop.shape[1])[None] == stop.shape[1] - 1
        for coarsely in (True, False):
            link_loss_within_stops(stop, lost.snapshots[:, first], limits, end, coarsely=coarsely)
        glitch_at_sampled_setpoints(begin, limits)
        if last >= Stage.FLIGHT:  # before encoding a flight, which ends the recording of calls
            from cfplan.flight.setpoints.commitment import Commitment, warm_up

            at_rest = encode_stops(encoded.motion, RATE, rows=np.array([-1, -1]) % len(encoded.payloads))
            warm_up(Commitment(0, encoded.payloads[-2:], at_rest), limits)
        if last >= Stage.REHEARSAL:
            from cfplan.preparation.plan_flight import PlannedFlight
            from cfplan.preparation.prepare_flight import encode_flight, make_mission, rehearse

            flight = PlannedFlight("small flight", planned, limits)
            encoded = encode_flight(flight)
            rehearse(flight, encoded)
            make_mission(encoded, limits)
        if last >= Stage.FLIGHT:
            from cfplan.simulation.virtual_crazyflie.vehicle import VirtualCrazyflie

            vehicle = VirtualCrazyflie(limits.airframe)
            for _ in range(3):
                vehicle.advance(10)
    return list(calls)
