"""The conductor as a pure core: what it hears of pilots, and what it tells them."""

import math
from dataclasses import replace

import pytest

from cfplan.errors import ExitCode
from cfplan.flight.fleet.conductor import (
    OBEYS_LATE,
    PILOT_SILENT,
    PREFLIGHT_SILENT,
    START_LEAD,
    ConductedFlight,
    Conductor,
    FlightEnded,
    Stage,
)
from cfplan.flight.pilot.conducted import CONDUCTOR_SILENT, ClearanceAsked, ConductorMessage, HeldConductor, PlanLeft
from cfplan.flight.pilot.health import UPLINK_GONE
from cfplan.flight.pilot.outcome import Rung
from cfplan.flight.telemetry import (
    Estimate,
    Event,
    Level,
    Phase,
    PhaseEntered,
    PoseReceived,
    SetpointSent,
    VehicleStatus,
)
from cfplan.planning.fleet.lost import NOTICED

APART, SKEW = 0.3, 0.03
LEVEL = (0.0, 0.0, 0.0, 1.0)


class Fleet:
    """Two vehicles 0.5 m from each other, as their conductor hears them."""

    def __init__(self, delay=0.0, right=(0.5, 0.0, 0.0), apart=APART, skew=SKEW):
        self.places = {"left": (0.0, 0.0, 0.0), "right": right}
        starts = {name: (x, y, 0.6) for name, (x, y, _) in self.places.items()}
        delays = {"left": 0.0, "right": delay}
        flights = [ConductedFlight(name, starts[name], delays[name]) for name in starts]
        self.conductor = Conductor(flights, apart, skew)
        self.now = 1000.0
        self.silent = set()

    def hear(self, name, message):
        self.conductor.hear(name, message, self.now)

    def ask(self, phase, *names):
        for name in names or self.places:
            self.hear(name, ClearanceAsked(phase))
        return self.go_on(0.01)

    def go_on(self, duration):
        """Let time pass, in which both are seen a hundred times a second; return what they are told at the end."""
        for _ in range(round(duration * 100)):
            self.now += 0.01
            for name, place in self.places.items():
                if name not in self.silent:
                    self.hear(name, PoseReceived(self.now - 0.01, self.now, place, LEVEL))
            said = self.conductor.say(self.now)
        return said

    def rise(self, name):
        x, y, _ = self.places[name]
        self.places[name] = (x, y, 0.6)
        return self.go_on(0.01)

    def fly(self):
        """Go to the start of all; return what they are told."""
        self.go_on(0.1)
        self.ask(Phase.ARM)
        self.ask(Phase.TAKE_OFF)
        for name in self.places:
            self.rise(name)
        return self.ask(Phase.STREAM)


def cleared(said, phase):
    return {name for name, message in said.items() if phase in message.cleared}


def setpoint(time, position, index=0):
    return SetpointSent(time, time, index, position, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), LEVEL, (0.0, 0.0, 0.0))


def braking(said):
    return {name for name, message in said.items() if message.brakes}


def test_nothing_is_armed_until_all_have_passed_preflight():
    fleet = Fleet()
    fleet.go_on(0.1)
    assert not cleared(fleet.ask(Phase.ARM, "left"), Phase.ARM)
    assert cleared(fleet.ask(Phase.ARM, "right"), Phase.ARM) == {"left", "right"}


def test_a_vehicle_that_fails_preflight_keeps_all_on_the_floor():
    fleet = Fleet()
    fleet.go_on(0.1)
    fleet.ask(Phase.ARM, "left")
    fleet.hear("right", FlightEnded(ExitCode.PREFLIGHT, "battery at rest: 3.5 V"))
    said = fleet.go_on(0.01)
    assert not cleared(said, Phase.ARM)
    assert "right: battery" in said["left"].brakes


@pytest.mark.parametrize(("place", "text"), [
    ((0.25, 0.0, 0.0), "beside its start"), ((0.0, 0.05, 0.0), "at the start of left"),
    ((0.5, 0.2, 0.0), "0.20 m beside"), ((0.5, 0.06, 0.0), "0.06 m beside"),
])  # fmt: skip
def test_a_vehicle_that_does_not_stand_under_its_start_keeps_all_on_the_floor(place, text):
    fleet = Fleet()
    fleet.places["right"] = place
    fleet.go_on(0.1)
    said = fleet.ask(Phase.ARM)
    assert braking(said) == {"left", "right"}
    assert not cleared(said, Phase.ARM)
    assert text in said["left"].brakes


@pytest.mark.parametrize(("x", "stand"), [(0.29, True), (0.27, False)])
def test_vehicles_stand_on_the_floor_as_far_apart_as_they_must_keep_in_the_air(x, stand):
    fleet = Fleet(right=(0.31, 0.0, 0.0))
    fleet.places["right"] = (x, 0.0, 0.0)
    fleet.go_on(0.1)
    said = fleet.ask(Phase.ARM)
    assert bool(cleared(said, Phase.ARM)) is stand
    assert ("stand 0.27 m apart" in said["left"].brakes) is not stand


def test_the_next_takes_off_when_the_one_before_has_risen():
    fleet = Fleet()
    fleet.go_on(0.1)
    fleet.ask(Phase.ARM)
    assert cleared(fleet.ask(Phase.TAKE_OFF), Phase.TAKE_OFF) == {"left"}
    assert cleared(fleet.go_on(2.0), Phase.TAKE_OFF) == {"left"}
    assert cleared(fleet.rise("left"), Phase.TAKE_OFF) == {"left", "right"}


def test_one_that_has_come_down_to_a_low_start_has_risen():
    fleet = Fleet()
    fleet.go_on(0.1)
    fleet.ask(Phase.ARM)
    fleet.ask(Phase.TAKE_OFF)
    for height in (0.6, 0.1):
        fleet.hear("left", PoseReceived(fleet.now, fleet.now, (0.0, 0.0, height), LEVEL))
    fleet.places["left"] = (0.0, 0.0, 0.1)
    assert cleared(fleet.go_on(0.01), Phase.TAKE_OFF) == {"left", "right"}


def test_all_begin_at_one_time_each_after_its_delay():
    fleet = Fleet(delay=0.7)
    said = fleet.fly()
    begins = fleet.conductor.begins
    assert begins == pytest.approx(fleet.now + START_LEAD)
    assert said["left"].cleared[Phase.STREAM] == begins
    assert said["right"].cleared[Phase.STREAM] == begins + 0.7
    assert fleet.go_on(1.0)["left"].cleared[Phase.STREAM] == begins
    assert fleet.conductor.stage is Stage.FLYING
    assert not braking(said)


def begin(fleet, name, late, index=0):
    """Let a vehicle begin its plan so late, s, and be heard at a setpoint."""
    begins = fleet.conductor.begins + (0.7 if name == "right" else 0.0) + late
    fleet.hear(name, PhaseEntered(begins - 0.01, Phase.STREAM))
    fleet.hear(name, setpoint(begins + 0.01 * index, (*fleet.places[name][:2], 0.6), index))


@pytest.mark.parametrize("skew", [0.03, 0.05])
@pytest.mark.parametrize(("more", "brakes"), [(-0.001, False), (0.001, True)])
def test_all_brake_when_one_begins_later_than_the_skew(skew, more, brakes):
    fleet = Fleet(delay=0.7, skew=skew)
    fleet.fly()
    fleet.go_on(1.3)
    begin(fleet, "left", skew + more)
    assert bool(braking(fleet.go_on(0.01))) is brakes


@pytest.mark.parametrize("skew", [0.03, 0.05])
@pytest.mark.parametrize(("more", "brakes"), [(-0.001, False), (0.001, True)])
def test_all_brake_when_two_clocks_differ_so_much_that_no_skew_is_left_for_orders(skew, more, brakes):
    fleet = Fleet(delay=0.7, skew=skew)
    fleet.fly()
    fleet.go_on(2.0)
    begin(fleet, "left", 0.005, index=70)
    begin(fleet, "right", 0.005 + skew - 0.01 + more)
    assert bool(braking(fleet.go_on(0.01))) is brakes


def test_a_pilot_that_stalls_and_skips_setpoints_has_the_clock_of_before():
    fleet = Fleet()
    fleet.fly()
    fleet.go_on(1.3)
    begins = fleet.conductor.begins + 0.02
    for name in fleet.places:
        fleet.hear(name, PhaseEntered(begins - 0.01, Phase.STREAM))
        fleet.hear(name, setpoint(begins, (*fleet.places[name][:2], 0.6)))
    skipped = setpoint(begins + 0.1, (0.5, 0.0, 0.6), 15)  # due 0.05 s before it was sent
    fleet.hear("right", replace(skipped, time=begins + 0.15))
    assert not braking(fleet.go_on(0.01))


def test_a_setpoint_that_is_sent_late_does_not_make_its_plan_late():
    fleet = Fleet()
    begins = fleet.fly()["right"].cleared[Phase.STREAM] + 0.015
    fleet.go_on(1.2)
    fleet.hear("right", PhaseEntered(begins - 0.01, Phase.STREAM))
    on_time = setpoint(begins + 0.3, (0.5, 0.0, 0.6), 30)
    fleet.hear("right", replace(on_time, time=begins + 0.34))
    assert not braking(fleet.go_on(0.01))


@pytest.mark.parametrize(("again", "brakes"), [(0.0, False), (0.3, True)])
def test_all_brake_when_a_vehicle_on_board_must_be_told_again_to_begin(again, brakes):
    """Its plan begins anew with each command, so it is not off its path."""
    fleet = Fleet(skew=SKEW + OBEYS_LATE)
    begins = fleet.fly()["right"].cleared[Phase.STREAM]
    fleet.go_on(1.2)
    fleet.hear("right", PhaseEntered(begins + 0.005, Phase.STREAM))
    for index in range(5):
        fleet.hear("right", setpoint(begins + 0.03 + again + 0.01 * index, (0.5, 0.0, 0.6), index))
    said = fleet.go_on(0.01)
    assert bool(braking(said)) is brakes
    assert ("right: it began its path 0.330 s late" in said["left"].brakes) is brakes


def test_a_pilot_that_hears_of_its_start_too_late_has_braked_before():
    fleet = Fleet()
    before = fleet.fly()["left"]
    now = fleet.now
    held = HeldConductor(lambda _: None, lambda: now)
    held.give(ConductorMessage({phase: time for phase, time in before.cleared.items() if phase is not Phase.STREAM}))
    assert held.brakes(before.cleared[Phase.STREAM])


def test_bodies_that_are_swapped_on_the_floor_are_named_and_nothing_is_armed():
    fleet = Fleet()
    fleet.places = {"left": fleet.places["right"], "right": fleet.places["left"]}
    fleet.go_on(0.1)
    said = fleet.ask(Phase.ARM)
    assert not cleared(said, Phase.ARM)
    assert "left stands at the start of right" in said["left"].brakes
    assert "swapped" in said["right"].brakes


def test_vehicles_hover_at_their_starts_until_the_program_lets_them_begin():
    fleet = Fleet()
    fleet.conductor.holds = True
    assert not cleared(fleet.fly(), Phase.STREAM)
    assert fleet.conductor.ready
    assert not cleared(fleet.go_on(5.0), Phase.STREAM)
    fleet.conductor.holds = False
    assert cleared(fleet.go_on(0.01), Phase.STREAM) == {"left", "right"}
    assert fleet.conductor.begins == pytest.approx(fleet.now + START_LEAD)
    assert not fleet.conductor.ready


def test_all_brake_when_one_leaves_its_plan():
    fleet = Fleet()
    fleet.fly()
    fleet.hear("left", PlanLeft(Rung.BRAKE, "the last good pose is 0.20 s old"))
    said = fleet.go_on(0.01)
    assert braking(said) == {"left", "right"}
    assert "left: the last good pose" in said["right"].brakes
    assert fleet.conductor.stage is Stage.BRAKING


def test_all_brake_as_soon_as_one_that_is_armed_ends_without_landing():
    """It does not take off, and takes seconds to say why, since its link is closed and it restarts before."""
    fleet = Fleet()
    fleet.go_on(0.1)
    fleet.ask(Phase.ARM)
    fleet.ask(Phase.TAKE_OFF)
    fleet.rise("left")
    fleet.hear("right", PhaseEntered(fleet.now, Phase.DISARM))
    assert braking(fleet.go_on(0.01)) == {"left"}
    assert "right: its flight ended before it landed" in fleet.conductor.brakes


def test_one_that_disarms_after_its_landing_is_no_reason_to_brake():
    fleet = Fleet()
    fleet.fly()
    for phase in (Phase.STREAM, Phase.LAND, Phase.DISARM):
        fleet.hear("right", PhaseEntered(fleet.now, phase))
    assert not braking(fleet.go_on(0.01))


def test_one_that_lands_at_its_end_goes_on_landing():
    fleet = Fleet()
    fleet.fly()
    fleet.hear("right", PhaseEntered(fleet.now, Phase.LAND))
    fleet.hear("left", PlanLeft(Rung.BRAKE, "late"))
    assert braking(fleet.go_on(0.01)) == {"left"}


def test_one_that_has_landed_is_no_reason_to_brake():
    fleet = Fleet()
    fleet.fly()
    fleet.hear("right", FlightEnded(ExitCode.OK, "landed"))
    fleet.silent.add("right")
    said = fleet.go_on(1.0)
    assert set(said) == {"left"}
    assert not braking(said)


def test_all_brake_when_a_pilot_is_silent():
    fleet = Fleet()
    fleet.fly()
    fleet.silent.add("right")
    assert not braking(fleet.go_on(PILOT_SILENT - 0.05))
    assert braking(fleet.go_on(0.1)) == {"left", "right"}
    assert "right" in fleet.conductor.brakes


def test_a_silent_pilot_and_a_dead_link_are_noticed_as_soon_as_the_certificate_of_lost_vehicles_takes_it():
    orders = 0.1  # s, of the conductor's tick and its orders
    assert PILOT_SILENT + orders <= NOTICED[1]
    assert UPLINK_GONE + orders <= NOTICED[1]


def test_no_pilot_waits_forever_for_one_that_fell_silent_in_preflight():
    fleet = Fleet()
    fleet.go_on(0.1)
    fleet.ask(Phase.ARM, "left")
    fleet.silent.add("right")
    assert not braking(fleet.go_on(PREFLIGHT_SILENT - 0.1))
    said = fleet.go_on(0.2)
    assert braking(said) == {"left", "right"}
    assert "right: neither setpoints nor poses came from its pilot" in said["left"].brakes
    assert not cleared(said, Phase.ARM)


def test_all_brake_when_a_tick_loop_hangs_while_the_radio_of_that_pilot_goes_on():
    fleet = Fleet()
    fleet.fly()
    fleet.silent.add("right")
    still = (0.0, 0.0, 0.0)
    for _ in range(round(100 * PILOT_SILENT) + 5):
        fleet.hear("right", Estimate(fleet.now, still, still, still, LEVEL))
        fleet.hear("right", VehicleStatus(fleet.now, still, (0, 0, 0, 0), 4.0, 0))
        fleet.hear("right", Event(fleet.now, Level.WARNING, "radio: busy"))
        said = fleet.go_on(0.01)
    assert braking(said) == {"left", "right"}
    assert "right: neither setpoints nor poses came from its pilot" in said["left"].brakes


def test_all_brake_as_soon_as_a_pilot_reports_that_its_link_is_lost():
    fleet = Fleet()
    fleet.fly()
    fleet.hear("right", Event(fleet.now, Level.ERROR, "the link was lost: the radio is gone"))
    assert "right: the link was lost" in fleet.go_on(0.01)["left"].brakes


@pytest.mark.parametrize("apart", [0.3, 0.4])
@pytest.mark.parametrize(("distance", "brakes"), [(0.21, False), (0.19, True)])
def test_all_brake_below_the_distance_that_allowed_deviations_leave_at_any_height(distance, brakes, apart):
    fleet = Fleet(apart=apart)
    fleet.fly()
    fleet.places["right"] = (distance, 0.0, 2.0)
    fleet.hear("right", setpoint(fleet.now, (distance, 0.0, 2.0)))
    assert bool(braking(fleet.go_on(0.02))) is brakes
    assert fleet.conductor.nearest == pytest.approx(distance)


@pytest.mark.parametrize("axis", [1, 2], ids=["to the side", "in height"])
@pytest.mark.parametrize(("apart", "off", "brakes"), [(0.3, 0.09, False), (0.3, 0.11, True), (0.4, 0.11, False)])
def test_all_brake_when_one_is_farther_off_its_path_than_certified(apart, off, brakes, axis):
    """It flies at 2 m/s along x, and is seen 20 ms late."""
    fleet = Fleet(apart=apart)
    fleet.fly()
    fleet.hear("right", PhaseEntered(fleet.now, Phase.STREAM))
    for tick in range(60):
        fleet.now += 0.01
        x = 0.5 + 0.02 * tick
        fleet.hear("right", setpoint(fleet.now, (x, 0.0, 0.6)))
        seen = [x - 0.04, 0.0, 0.6]
        seen[axis] -= off * (tick > 30)
        fleet.hear("right", PoseReceived(fleet.now - 0.02, fleet.now, tuple(seen), LEVEL))
        fleet.hear("left", PoseReceived(fleet.now, fleet.now, (0.0, 0.0, 0.6), LEVEL))
        said = fleet.conductor.say(fleet.now)
    assert bool(braking(said)) is brakes
    assert ("right: it is 0.11 m from its place" in said["left"].brakes) is brakes


@pytest.mark.parametrize(("off", "brakes"), [(0.09, False), (0.11, True)])
@pytest.mark.parametrize("flown", [False, True], ids=["before its path", "after its path"])
def test_all_brake_when_one_that_hovers_moves_off_its_place(flown, off, brakes):
    fleet = Fleet(apart=0.3)
    fleet.fly()
    if flown:
        fleet.hear("right", PhaseEntered(fleet.now, Phase.STREAM))
        fleet.hear("right", setpoint(fleet.now, (1.5, 0.0, 0.6)))
        fleet.hear("right", PhaseEntered(fleet.now, Phase.HOLD))
    x = 1.5 if flown else 0.5
    fleet.places["right"] = (x, off, 0.6)
    assert bool(braking(fleet.go_on(0.02))) is brakes


def test_a_vehicle_seen_later_than_another_is_compared_at_one_moment():
    fleet = Fleet()
    fleet.fly()
    for step in range(1, 40):  # both move at 2 m/s; the right one is seen 0.1 s late, 0.2 m nearer than it is
        fleet.now += 0.01
        for name, begins in (("left", 0.0), ("right", 0.5)):
            fleet.hear(name, setpoint(fleet.now, (begins + 0.02 * step, 0.0, 0.6)))
        fleet.hear("left", PoseReceived(fleet.now, fleet.now, (0.02 * step, 0.0, 0.6), LEVEL))
        if step > 10:
            seen = 0.5 + 0.02 * (step - 10)
            fleet.hear("right", PoseReceived(fleet.now - 0.1, fleet.now, (seen, 0.0, 0.6), LEVEL))
        said = fleet.conductor.say(fleet.now)
    assert not braking(said)
    assert fleet.conductor.nearest > 0.45


def test_a_pilot_that_does_not_hear_its_conductor_brakes():
    now = 0.0
    told = []
    held = HeldConductor(told.append, lambda: now)
    held.give(ConductorMessage({Phase.ARM: 0.5}))
    assert held.clearance(Phase.ARM) == 0.5
    assert held.clearance(Phase.STREAM) == math.inf
    assert not held.brakes(CONDUCTOR_SILENT - 0.01)
    assert "silent" in held.brakes(CONDUCTOR_SILENT + 0.01)
    held.give(ConductorMessage({}, "left: late"))
    assert held.brakes(CONDUCTOR_SILENT + 0.01) == "left: late"
    held.ask(Phase.ARM)
    assert told == [ClearanceAsked(Phase.ARM)]
