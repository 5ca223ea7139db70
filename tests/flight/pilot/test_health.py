"""The table of health: the pilot's reactions to sources that fall silent, alone and together, in every phase."""

import itertools

import pytest
from slow_cases import slow_unless

from cfplan.errors import ExitCode
from cfplan.flight.pilot.health import FRESH, GONE, LATE, Descent, Freshness, Health, HealthMonitor
from cfplan.flight.telemetry import Phase

PHASES = (Phase.TAKE_OFF, Phase.GO_TO_START, Phase.STREAM, Phase.HOLD, Phase.LAND)
SILENT = {"uplink": "uplink_dead", "poses": "poses_stopped", "estimate": "estimate_silent", "status": "status_silent"}
CELLS = [Health(*cell) for cell in itertools.product(Freshness, repeat=4)]
FOR_GOOD = [cell for cell in CELLS if LATE not in (cell.uplink, cell.poses, cell.estimate, cell.status)]
ONE_LATE = [Health(**{source: LATE}) for source in SILENT]
LATE_FOR = 0.35  # s
MOMENT = dict.fromkeys(Phase, 0.3) | {Phase.STREAM: 0.1}  # s; early in the stream, where it is slow and lags little


def silence(world, source, phase, spans):
    """Silence a source in each span, s after its MOMENT in the phase; an end of None is never."""
    for begin, end in spans:
        world.when(phase, MOMENT[phase] + begin, lambda: setattr(world, SILENT[source], True))
        if end is not None:
            world.when(phase, MOMENT[phase] + end, lambda: setattr(world, SILENT[source], False))


def bring_about(world, cell, phase):
    for source in SILENT:
        now = getattr(cell, source)
        if now is not FRESH:
            silence(world, source, phase, [(0.0, LATE_FOR if now is LATE else None)])


def assert_reaction(world, outcome, cell):
    """Assert the reaction that the table has for the cell."""
    if cell.uplink is GONE:  # the vehicle is alone, and comes down by link loss
        assert outcome.exit_code is ExitCode.LINK_LOST
        assert "disarm" not in world.calls
        return
    assert outcome.rung is cell.reaction.rung
    assert outcome.exit_code is (ExitCode.ENDED_BY_SAFETY if cell.reaction.rung else ExitCode.OK)
    assert world.position[2] < 0.05
    assert world.motors_off_in_the_air == 0.0
    assert not world.motors_on
    assert not world.armed
    assert world.closed
    assert "emergency stop" not in world.calls


@pytest.mark.parametrize("phase", slow_unless([Phase.STREAM, Phase.LAND], PHASES))
@pytest.mark.parametrize(
    "cell",
    slow_unless(FOR_GOOD + ONE_LATE, CELLS),
    ids=lambda cell: "-".join(getattr(cell, source) for source in SILENT),
)
def test_each_cell_in_each_phase(world, fly, cell, phase):
    bring_about(world, cell, phase)
    assert_reaction(world, fly(), cell)


@pytest.mark.parametrize("phase", slow_unless([Phase.STREAM], PHASES))
@pytest.mark.parametrize("logs", [("estimate",), ("status",), ("estimate", "status")])
def test_logs_that_come_back_for_a_moment_and_go_again_land_by_poses(world, fly, logs, phase):
    for log in logs:
        silence(world, log, phase, [(0.0, 0.7), (0.8, None)])
    assert_reaction(world, fly(), Health(**dict.fromkeys(logs, GONE)))
    assert world.revived == list(logs)


@pytest.mark.parametrize("phase", PHASES)
def test_poses_that_come_back_for_a_moment_and_go_again_land(world, fly, phase):
    silence(world, "poses", phase, [(0.0, 0.7), (0.8, None)])
    assert_reaction(world, fly(), Health(poses=GONE))


@pytest.mark.parametrize("phase", [phase for phase in PHASES if phase is not Phase.LAND])
def test_an_uplink_that_comes_back_for_a_moment_and_goes_again_is_lost(world, fly, phase):
    silence(world, "uplink", phase, [(0.0, 0.7), (0.8, None)])
    outcome = fly()
    assert outcome.exit_code is ExitCode.LINK_LOST
    assert "disarm" not in world.calls


@pytest.mark.parametrize("phase", PHASES)
def test_an_uplink_that_comes_back_lands_the_vehicle_where_it_is(world, fly, phase):
    silence(world, "uplink", phase, [(0.0, 0.7)])
    assert_reaction(world, fly(), Health(estimate=GONE))


def test_an_armed_vehicle_whose_status_fell_silent_is_disarmed_by_more_than_one_packet(world, fly):
    world.when(Phase.ARM, 0.0, lambda: vars(world).update(status_silent=True, arms_lost=0))
    world.when(Phase.DISARM, 0.0, lambda: setattr(world, "arms_lost", 1))
    fly()
    assert world.calls.count("disarm") > 1
    assert not world.armed
    assert "does not confirm that it is disarmed" in world.said


def test_a_silent_vehicle_that_acknowledges_flies_its_certified_stop(world, fly, mission):
    for log in ("estimate", "status"):
        silence(world, log, Phase.STREAM, [(0.0, None)])
    begun = dict(fly().phases)[Phase.LAND]
    sent = {round(each.time, 4): each.position for each in world.sent() if each.time < begun}
    streamed = list(sent.values())
    steps = [max(abs(b - a) for a, b in zip(one, other, strict=True)) for one, other in itertools.pairwise(streamed)]
    assert max(steps) < 0.03  # m, at 2.2 m/s and 100 Hz: nowhere does the setpoint jump


def test_every_cell_has_a_reaction_and_a_graver_source_never_a_lesser_one():
    order = {freshness: place for place, freshness in enumerate(Freshness)}
    for cell, other in itertools.product(CELLS, CELLS):
        if all(order[getattr(cell, source)] <= order[getattr(other, source)] for source in SILENT):
            assert cell.reaction.rung <= other.reaction.rung


def test_the_way_down_depends_on_uplink_and_poses_alone():
    for cell in CELLS:
        expected = Descent.HELD if cell.uplink is GONE else Descent.BLIND if cell.poses is GONE else Descent.BY_POSES
        assert cell.reaction.descent is expected


def test_a_computer_that_stood_still_hears_before_it_judges(limits):
    monitor = HealthMonitor(limits.pose)
    heard = dict.fromkeys(("uplink", "estimate", "status", "poses"), 9.999)
    assert monitor.look(10.0, **heard) == Health()
    stalled = monitor.look(11.0, **heard)
    assert (stalled.uplink, stalled.poses) == (FRESH, GONE)  # poses have grown old all the same
    for step in range(1, 60):
        last = monitor.look(11.0 + step / 100, **heard)
    assert last == Health(GONE, GONE, GONE, GONE)


@pytest.mark.parametrize("log", ["estimate", "status"])
def test_a_log_that_is_silent_before_take_off_fails_preflight(world, fly, log):
    silence(world, log, Phase.CONVERGE, [(0.0, None)])
    outcome = fly()
    assert outcome.exit_code is ExitCode.PREFLIGHT
    assert f"{log} silent" in outcome.reason
    assert "arm" not in world.calls


def test_a_status_that_falls_silent_while_the_vehicle_arms_keeps_it_on_the_floor(world, fly):
    world.when(Phase.ARM, 0.0, lambda: setattr(world, "status_silent", True))
    outcome = fly()
    assert outcome.exit_code is ExitCode.PREFLIGHT
    assert world.position[2] == world.floor
    assert not world.armed


@pytest.mark.parametrize("silent_after", [0.4, 0.6, 0.8])
def test_a_status_that_falls_silent_while_a_take_off_is_given_up_leaves_nothing_armed(world, fly, silent_after):
    world.other_body = True
    world.when(Phase.TAKE_OFF, silent_after, lambda: setattr(world, "status_silent", True))
    outcome = fly()
    assert outcome.exit_code in (ExitCode.PREFLIGHT, ExitCode.ENDED_BY_SAFETY)
    assert "fault" not in outcome.reason
    assert "emergency stop" not in world.calls
    assert not world.armed
    assert not world.motors_on
