"""Every file of flights/ in the vehicle's memory: decoded, certified, and flown on board in the simulator."""

from pathlib import Path

import pytest

from cfplan.flight.on_board.memory_format import read_compressed, read_raw
from cfplan.flight.on_board.piece_certificate import certify_pieces
from cfplan.flight.setpoints.encoding import encode_trajectory
from cfplan.flight.setpoints.rate_trade import gains_under
from cfplan.preparation.export_flight import Form, fit_polynomials, plan_for_polynomials
from cfplan.preparation.plan_flight import FlightOptions
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.dry_run import dry_run

REPOSITORY = Path(__file__).parents[2]
FLIGHTS = sorted((REPOSITORY / "flights").glob("*.yaml"))
WORSE = 0.02  # m, by which the deviation is at most larger than that of the same plan, streamed

pytestmark = [pytest.mark.integration, pytest.mark.slow]


@pytest.mark.parametrize("file", FLIGHTS, ids=[file.stem for file in FLIGHTS])
def test_a_path_file_flies_on_board(file):
    limits = load_limits(REPOSITORY / "safety.yaml")
    planned = plan_for_polynomials(file, limits, FlightOptions())
    exported = fit_polynomials(planned, Form.MEMORY)
    made = exported.on_board
    decoded = read_compressed(made.memory) if made.compressed else read_raw(made.memory, len(made.pieces.durations))
    assert certify_pieces(decoded, limits.airframe, limits.plan, limits.space).passed
    plan = planned.plan.trajectory
    streamed = encode_trajectory(plan, gains=gains_under(limits), space=limits.space)
    by_stream = dry_run(streamed, plan, limits).deviation
    print(
        f"{file.stem}: {len(decoded.durations)} pieces, {len(made.memory)} bytes, {made.duration:.1f} s of "
        f"{planned.duration:.1f} s, {100 * exported.dry_run.deviation:.1f} cm, {100 * by_stream:.1f} cm streamed"
    )
    assert exported.dry_run.deviation < by_stream + WORSE
