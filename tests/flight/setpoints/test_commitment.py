"""Commitments: new plans replace the rest from a splice on without a jump; all else is refused and changes nothing."""

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cfplan.errors import InfeasibleError, InputError, NotCertifiedError
from cfplan.flight.setpoints.byte_check import check_bytes
from cfplan.flight.setpoints.commitment import (
    KEPT_BEHIND,
    LEAST_AHEAD,
    Commitment,
    Fault,
    Proposal,
    Refusal,
    checksum_of,
    propose,
    splice,
)
from cfplan.flight.setpoints.encoding import LEAD, RATE, encode_trajectory
from cfplan.flight.setpoints.motion_certificate import SPAN, motion_extremes
from cfplan.flight.setpoints.packets import (
    QUATERNION_PLACE,
    FullStateSetpoints,
    compress_quaternion,
    decode,
    encode,
)
from cfplan.flight.setpoints.stop_certificate import certify_stops
from cfplan.flight.setpoints.stops import encode_stops
from cfplan.geometry.min_snap import min_snap
from cfplan.planning.continuation import continue_plan
from cfplan.planning.plan import plan
from cfplan.safety.limits_file import load_limits
from cfplan.vehicle.joint import JoinedTrajectory

WAYPOINTS = np.array([[-1.2, -2.0, 0.8], [1.0, -1.0, 1.2], [-0.8, 0.6, 0.9], [0.9, 2.0, 1.2]])
LIMITS = load_limits(Path(__file__).parents[3] / "safety.yaml")
SPACE = LIMITS.space
LOW, HIGH = np.array([-1.3, -2.8, 0.7]), np.array([1.3, 2.8, 1.3])


def encoded(flown: JoinedTrajectory, first: int):
    return encode_trajectory(flown.since(first / RATE), space=SPACE)


def stops_of(payloads):
    return encode_stops(payloads.motion, RATE, gains=payloads.gains, space=SPACE)


@pytest.fixture(scope="module")
def limits():
    """The limits of the project's own safety.yaml."""
    return LIMITS


@pytest.fixture(scope="module")
def flown(limits):
    made = plan(min_snap(WAYPOINTS), limits.airframe, limits, planner="expert")
    return JoinedTrajectory((made.trajectory,), (0.0,))


@pytest.fixture(scope="module")
def committed(flown):
    setpoints = encoded(flown, 0)
    return Commitment(0, setpoints.payloads, stops_of(setpoints))


def continued(flown, committed, number, waypoints, limits):
    """The flight that leaves `flown` at setpoint `number`, and its setpoints from there on, the first as committed."""
    joint = number / RATE + LEAD
    new = continue_plan(flown.trajectories[-1], joint - flown.starts[-1], waypoints, limits, leave_room=False)
    joined = flown.continued(joint, new.plan.trajectory)
    setpoints = encoded(joined, number)
    payloads = setpoints.payloads.copy()
    payloads[0] = committed.payloads[number - committed.first]
    return joined, replace(setpoints, payloads=payloads, decoded=decode(payloads))


@pytest.fixture(scope="module")
def spliced(flown, committed, limits):
    """A flight and the proposal that makes it, with the splice at setpoint 120."""
    joined, setpoints = continued(flown, committed, 120, [[0.2, 1.0, 1.3], [-1.0, 2.4, 1.0]], limits)
    return joined, propose(committed, 120, setpoints.payloads, stops_of(setpoints))


def resummed(proposal: Proposal) -> Proposal:
    return replace(proposal, checksum=checksum_of(proposal.splice, proposal.payloads, proposal.stops))


def test_a_new_plan_replaces_the_rest_and_nothing_jumps(committed, spliced, limits):
    joined, proposal = spliced
    new = splice(committed, proposal, 110, limits)
    assert isinstance(new, Commitment)
    assert new.splices == (120,)
    begin = 110 - KEPT_BEHIND
    assert new.first == begin
    np.testing.assert_array_equal(new.payloads[: 120 - begin], committed.payloads[begin:120])
    # What is sent is the encoding of the joined trajectory, and at the splice it is what was committed, to the byte.
    np.testing.assert_array_equal(proposal.payloads[0], committed.payloads[120])
    state = decode(new.payloads)
    assert np.linalg.norm(np.diff(state.velocity, axis=0), axis=1).max() < 1.2 * limits.plan.acceleration / RATE
    np.testing.assert_allclose(state.position[-1], joined.at(joined.duration).position, atol=5.1e-4)


def test_its_bytes_and_stops_pass_the_checks_of_every_plan(spliced, limits):
    joined, _ = spliced
    setpoints = encoded(joined, 120)
    check_bytes(setpoints, joined.since(120 / RATE), limits.plan)
    certify_stops(stops_of(setpoints), setpoints.motion, limits, RATE, space=SPACE).require(limits)


def test_splices_follow_one_another(flown, committed, spliced, limits):
    joined, proposal = spliced
    one = splice(committed, proposal, 100, limits)
    further, setpoints = continued(joined, one, 155, [[-0.3, 1.4, 1.1], [1.0, 2.2, 0.9]], limits)
    second = splice(one, propose(one, 155, setpoints.payloads, stops_of(setpoints)), 140, limits)
    assert isinstance(second, Commitment)
    assert second.splices == (120, 155)
    assert second.last == 155 + len(setpoints.payloads) - 1
    assert further.starts[1:] == pytest.approx((1.205, 1.555))


def test_what_is_flown_before_a_splice_far_ahead_stays(flown, committed, limits):
    """Of setpoints so far behind that no vehicle is there any more, but not of those between now and the splice."""
    _, setpoints = continued(flown, committed, 300, [[-0.4, 2.0, 1.0]], limits)
    for now in (20, 150, 290):
        new = splice(committed, propose(committed, 300, setpoints.payloads, stops_of(setpoints)), now, limits)
        assert new.first == max(now - KEPT_BEHIND, 0)
        ahead = slice(now - new.first, 301 - new.first)
        np.testing.assert_array_equal(new.payloads[ahead], committed.payloads[now:301])
        np.testing.assert_array_equal(new.stops[ahead][:-1], committed.stops[now:300])


def test_the_same_proposal_makes_the_same_checksum_whenever_it_comes(committed, spliced, limits):
    """So planner and pilot agree about what is committed, though they look at different moments."""
    _, proposal = spliced
    early, late = (splice(committed, proposal, now, limits) for now in (5, 118))
    assert early.first != late.first
    assert early.checksum == late.checksum != committed.checksum


def test_what_is_committed_cannot_be_changed(committed):
    with pytest.raises(ValueError, match="read-only"):
        committed.payloads[0] = 0
    mine = committed.payloads.copy()
    held = Commitment(0, mine, committed.stops)
    mine[:] = 0
    assert held.checksum == committed.checksum
    np.testing.assert_array_equal(held.payloads, committed.payloads)


@pytest.mark.parametrize(
    ("payloads", "stops"),
    [
        (lambda p: p[:, :28], lambda s: s),
        (lambda p: p[:-1], lambda s: s),
        (lambda p: p[:0], lambda s: s[:0]),
        (lambda p: p.astype(float), lambda s: s),
        (lambda p: p * 0, lambda s: s),
        (lambda p: p, lambda s: s[:, :, :3]),
        (lambda p: p, lambda s: s * 0),
    ],
)
def test_what_are_no_setpoints_is_no_commitment(committed, payloads, stops):
    with pytest.raises(NotCertifiedError):
        Commitment(0, payloads(committed.payloads), stops(committed.stops))


def moved(array, row, column, by):
    """The same bytes with one 16-bit number changed."""
    changed = array.copy()
    changed[row].view()[column : column + 2].view("<i2")[:] += by
    return changed


FAULTS = {
    "late": (lambda p: p, 120 - LEAST_AHEAD + 1, Fault.LATE),
    "long past": (lambda p: p, 10_000, Fault.LATE),
    "for another commitment": (lambda p: replace(p, follows=p.follows ^ 1), 0, Fault.ORDER),
    "a bit flipped": (lambda p: replace(p, payloads=moved(p.payloads, 50, 1, 1)), 0, Fault.CHECKSUM),
    "another splice": (lambda p: replace(p, splice=121), 0, Fault.CHECKSUM),
    "made for another setpoint": (lambda p: resummed(replace(p, splice=121)), 0, Fault.JOINT),
    "beyond what is committed": (lambda p: resummed(replace(p, splice=100_000)), 0, Fault.OUTSIDE),
    "begins two millimetres off": (lambda p: resummed(replace(p, payloads=moved(p.payloads, 0, 3, 2))), 0, Fault.JOINT),
    "begins 2 mm/s off": (lambda p: resummed(replace(p, payloads=moved(p.payloads, 0, 7, 2))), 0, Fault.JOINT),
    "begins with another attitude": (
        lambda p: resummed(replace(p, payloads=moved(p.payloads, 0, 19, 40))), 0, Fault.JOINT,
    ),
    "jumps by 10 cm": (lambda p: resummed(replace(p, payloads=moved(p.payloads, 60, 1, 100))), 0, Fault.MOTION),
    "ends in motion": (
        lambda p: resummed(replace(p, payloads=p.payloads[:80], stops=p.stops[:80])), 0, Fault.END,
    ),
    "stops of other setpoints": (lambda p: resummed(replace(p, stops=np.roll(p.stops, 20, axis=0))), 0, Fault.STOPS),
    "stops that do not stop": (
        lambda p: resummed(replace(p, stops=np.repeat(p.stops[:, :1], p.stops.shape[1], axis=1))), 0, Fault.STOPS,
    ),
    "shorter stops": (lambda p: resummed(replace(p, stops=p.stops[:, 1:])), 0, Fault.SHAPE),
    "fewer stops": (lambda p: replace(p, stops=p.stops[1:]), 0, Fault.SHAPE),
    "more than a pilot verifies in time": (
        lambda p: resummed(
            replace(p, payloads=np.resize(p.payloads, (5000, 29)), stops=np.resize(p.stops, (5000, *p.stops.shape[1:])))
        ),
        0, Fault.SHAPE,
    ),
    "no bytes": (lambda p: replace(p, payloads=p.payloads.astype(float)), 0, Fault.SHAPE),
    "nothing": (lambda p: None, 0, Fault.SHAPE),
    "text": (lambda p: "fly!", 0, Fault.SHAPE),
    "a number that is none": (lambda p: replace(p, splice=float("nan")), 0, Fault.SHAPE),
}  # fmt: skip


@pytest.mark.parametrize("case", FAULTS)
def test_what_is_wrong_is_refused_in_words(committed, spliced, limits, case):
    make, now, fault = FAULTS[case]
    before = committed.payloads.copy(), committed.stops.copy(), committed.checksum
    refused = splice(committed, make(spliced[1]), now, limits)
    assert isinstance(refused, Refusal)
    assert refused.fault is fault
    assert str(refused).startswith(str(fault))
    np.testing.assert_array_equal(committed.payloads, before[0])
    np.testing.assert_array_equal(committed.stops, before[1])
    assert checksum_of(committed.first, committed.payloads, committed.stops) == before[2]


def test_a_proposal_that_leaves_the_space_is_refused(committed, spliced, limits):
    smaller = replace(limits.space, high=(limits.space.high[0], 1.5, limits.space.high[2]))
    refused = splice(committed, spliced[1], 0, replace(limits, space=smaller))
    assert refused.fault is Fault.SPACE


def at_most(limits, **plan):
    return replace(limits, plan=replace(limits.plan, **plan))


@pytest.mark.parametrize(
    ("noun", "lowered"),
    [
        ("speed", lambda p: {"speed": 0.97 * p.speed}),
        ("acceleration", lambda p: {"acceleration": 0.95 * p.acceleration}),
        ("angular velocity", lambda p: {"angular_velocity": 0.3 * p.angular_velocity}),
        ("tilt", lambda p: {"tilt": 0.9 * p.tilt}),
        ("motor thrust", lambda p: {"motor_thrust_max": 0.75 * p.motor_thrust_max}),
        ("specific thrust", lambda p: {"specific_thrust_min": 9.7}),
    ],
)
def test_a_proposal_that_exceeds_a_limit_of_plans_is_refused(committed, spliced, limits, noun, lowered):
    """The proposal was planned, certified and signed under other limits."""
    _, proposal = spliced
    refused = splice(committed, proposal, 110, at_most(limits, **lowered(limits.plan)))
    assert isinstance(refused, Refusal)
    assert refused.fault is Fault.LIMITS
    assert re.search(rf"^setpoint \d+ reaches an? {noun} of", refused.detail)
    number = int(refused.detail.split()[1])
    assert 120 <= number < 120 + len(proposal.payloads)


@pytest.mark.parametrize(
    ("noun", "lowered"),
    [
        ("speed", lambda flight: replace(flight, speed=replace(flight.speed, brake=1.5))),
        ("acceleration", lambda flight: replace(flight, acceleration=replace(flight.acceleration, brake=3.0))),
        (
            "angular velocity",
            lambda flight: replace(flight, angular_velocity=replace(flight.angular_velocity, brake=1)),
        ),
        ("tilt", lambda flight: replace(flight, stop_tilt=0.4)),
    ],
)
def test_a_proposal_with_a_stop_that_exceeds_what_stops_may_reach_is_refused(committed, spliced, limits, noun, lowered):
    refused = splice(committed, spliced[1], 110, replace(limits, flight=lowered(limits.flight)))
    assert isinstance(refused, Refusal)
    assert refused.fault is Fault.LIMITS
    assert re.search(rf"^setpoint \d+ of the stop from setpoint \d+ reaches an? {noun} of", refused.detail)


# By byte, the change of a number in a packet, in thousandths: positions, velocities, thrusts and rates of no plan.
COLUMNS = {
    1: 100,
    3: 100,
    5: -100,
    7: 800,
    9: -800,
    11: 800,
    13: 30_000,
    15: -30_000,
    17: 30_000,
    23: 12_000,
    27: -12_000,
}


@settings(max_examples=200, deadline=None)
@given(data=st.data())
def test_one_number_of_any_setpoint_of_any_stop_counts(committed, spliced, limits, data):
    _, proposal = spliced
    column = data.draw(st.sampled_from(sorted(COLUMNS)))
    row = data.draw(st.integers(1, len(proposal.payloads) - 2))
    within = data.draw(st.integers(1, proposal.stops.shape[1] - 2))
    stops = moved(proposal.stops, (row, within), column, COLUMNS[column])
    payloads = moved(proposal.payloads, row, column, COLUMNS[column])
    for broken in (replace(proposal, stops=stops), replace(proposal, payloads=payloads)):
        assert isinstance(splice(committed, resummed(broken), 100, limits), Refusal)
    refused = splice(committed, resummed(replace(proposal, stops=stops)), 100, limits)
    assert f"of the stop from setpoint {120 + row}" in refused.detail


def turned_round(rows):
    """Return setpoints (..., 29) whose heading is turned by 180°."""
    x, y, z, w = decode(rows.reshape(-1, rows.shape[-1])).quaternion.T
    turned = rows.copy()
    packed = compress_quaternion(np.column_stack([-y, x, w, -z])).astype("<u4").view(np.uint8)
    turned[..., QUATERNION_PLACE : QUATERNION_PLACE + 4] = packed.reshape(*rows.shape[:-1], 4)
    return turned


@pytest.mark.parametrize("begin", [0, 40])
def test_a_heading_that_turns_at_once_is_refused_in_setpoints_and_in_their_stops(committed, spliced, limits, begin):
    _, proposal = spliced
    payloads, stops = proposal.payloads.copy(), proposal.stops.copy()
    payloads[50:52] = turned_round(payloads[50:52])
    stops[30, begin:60] = turned_round(stops[30, begin:60])
    for broken in (replace(proposal, payloads=payloads), replace(proposal, stops=stops)):
        refused = splice(committed, resummed(broken), 110, limits)
        assert isinstance(refused, Refusal)
        assert refused.fault in (Fault.LIMITS, Fault.STOPS)


def test_two_setpoints_of_any_pitch_turn_the_heading_by_nothing(limits):
    """Alone, so that a rounding below zero is the worst value."""
    pitches = np.linspace(-0.35, 0.35, 141)
    turns = np.stack([0.0 * pitches, np.sin(pitches / 2), 0.0 * pitches, np.cos(pitches / 2)], axis=1)
    still = np.zeros((141, 3))
    payloads = encode(FullStateSetpoints(still, still, still, turns, still))
    for row in range(140):
        run, before = payloads[None, row : row + 2], payloads[[row] * (SPAN + 1)]
        assert motion_extremes(run, before, limits.airframe, end=1).turn < 1e-6


def test_setpoints_that_only_claim_to_be_a_stop_are_refused(committed, spliced, limits):
    _, proposal = spliced
    refused = splice(committed, replace(proposal, ending=len(proposal.stops) - 1), 100, limits)
    assert refused.fault is Fault.STOPS


VERIFYING = """
import sys
import numpy as np
from numba.core import event
from cfplan.flight.setpoints.commitment import Commitment, Proposal, splice, warm_up
from cfplan.safety.limits_file import load_limits

limits, held = load_limits(sys.argv[1]), np.load(sys.argv[2])
committed = Commitment(0, held["payloads"], held["stops"])
warm_up(committed, limits)
with event.install_recorder("numba:compile") as compiled:
    spliced = splice(committed, Proposal.of_bytes(held["proposal"].tobytes()), 110, limits)
print(type(spliced).__name__, len(compiled.buffer))
"""


def test_once_warmed_up_a_pilot_compiles_nothing(committed, spliced, tmp_path):
    np.savez(
        tmp_path / "held.npz", payloads=committed.payloads, stops=committed.stops,
        proposal=np.frombuffer(spliced[1].to_bytes(), np.uint8),
    )  # fmt: skip
    safety_file = Path(__file__).parents[3] / "safety.yaml"
    done = subprocess.run(
        [sys.executable, "-c", VERIFYING, str(safety_file), str(tmp_path / "held.npz")],
        cwd=safety_file.parent, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.split() == ["Commitment", "0"]


@settings(max_examples=30, deadline=None)
@given(
    number=st.integers(0, 600),
    ahead=st.integers(-20, 60),
    points=st.lists(
        st.tuples(*(st.floats(float(a), float(b)) for a, b in zip(LOW, HIGH, strict=True))), min_size=1, max_size=3
    ),
)
def test_random_splices_are_flown_without_a_jump_or_refused(flown, committed, limits, number, ahead, points):
    """Whatever continues the flight: what is committed ends at rest inside the space and never jumps."""
    try:
        joined, setpoints = continued(flown, committed, number, points, limits)
    except (InfeasibleError, InputError):  # no such plan: nothing to propose
        return
    proposal = propose(committed, number, setpoints.payloads, stops_of(setpoints))
    result = splice(committed, proposal, number - ahead, limits)
    assert isinstance(result, Commitment) == (ahead >= LEAST_AHEAD)
    if isinstance(result, Refusal):
        assert result.fault is Fault.LATE
        return
    state = decode(result.payloads)
    assert limits.space.beyond(state.position).max() <= 1e-3
    assert not state.velocity[-1].any()
    assert np.linalg.norm(np.diff(state.velocity, axis=0), axis=1).max() < 1.2 * limits.plan.acceleration / RATE
    at = np.array([(result.first + row) / RATE for row in range(len(result.payloads))])
    np.testing.assert_allclose(state.position, joined.at(at + LEAD).position, atol=5.1e-4)


@settings(max_examples=200, deadline=None)
@given(data=st.data())
def test_a_broken_proposal_is_refused_whatever_is_broken(committed, spliced, limits, data):
    """Bytes overwritten at random, with the checksum made good or not."""
    _, proposal = spliced
    which = data.draw(st.sampled_from(["payloads", "stops"]))
    array = getattr(proposal, which).copy()
    count = data.draw(st.integers(1, 400))
    places = np.random.default_rng(data.draw(st.integers(0, 2**32 - 1))).integers(0, array.size, count)
    array.reshape(-1)[places] ^= data.draw(st.integers(1, 255))
    broken = replace(proposal, **{which: array})
    refused = splice(committed, broken, 100, limits)
    assert isinstance(refused, Refusal)
    made_good = splice(committed, resummed(broken), 100, limits)
    if isinstance(made_good, Commitment):  # what the pilot can see of it is sound
        state = decode(made_good.payloads)
        assert limits.space.beyond(state.position).max() <= 1e-3
        assert not state.velocity[-1].any()
