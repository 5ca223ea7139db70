"""What earlier flights of a plan teach: what repeats is taken back, what does not averages out."""

import numpy as np
import pytest

from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.identification.earlier_flights import HOVER, LARGEST, EarlierFlight, learn_correction
from cfplan.recording.summary import SETTLED
from cfplan.vehicle.airframes import AIRFRAMES
from cfplan.vehicle.correction import PlanCorrection, corrected
from cfplan.vehicle.trajectory import Trajectory


@pytest.fixture(scope="module")
def planned(make_profile):
    path = min_snap([[0, 0, 1], [1.5, 1, 1.4], [1, -1.5, 0.6], [-1, 0.5, 1.2]])
    return Trajectory(path, make_profile(path.end, np.full(30, 1.5)), AIRFRAMES["crazyflie-2.1+"])


def straying(trajectory, s):
    """By how much the vehicle strays at s, (N, 3) m, whatever it is asked to fly."""
    x = s / trajectory.path.end
    share = x**3 * (10.0 - 15.0 * x + 6.0 * x**2)  # it begins and ends in hover
    return 0.05 * np.stack([np.sin(2 * np.pi * share), np.sin(np.pi * share) ** 2, 0.0 * share - 0.3], axis=1)


def flown(planned, asked=None, *, chance=0.0, seed=0, gap=(0.0, 0.0), more=0.0):
    """A flight that strays by what repeats, by a slow wave that does not, and by noise of 1 mm."""
    asked, random = asked or planned, np.random.default_rng(seed)
    times = np.arange(0.0, asked.duration + HOVER + 0.1, 0.01)
    times = times[(times <= gap[0]) | (times >= gap[1])]
    wave = PlanCorrection(random.normal(0.0, chance, (round(planned.duration / 0.5), 3)), planned.duration)
    s = asked.s_at(times)
    off = straying(planned, s) + wave.at(planned.time_at(s))[:, 0] + random.normal(0.0, 1e-3, (len(times), 3))
    off[len(off) // 2] += more
    return EarlierFlight("records/there", planned, asked, times, asked.path(s) + off)


def left(planned, learned):
    """By how much a vehicle strays with a correction, without noise, (N, 3) m."""
    times = np.linspace(0.0, planned.duration, 300)
    return straying(planned, planned.s_at(times)) + learned.correction.at(times)[:, 0]


def rms(off):
    return np.sqrt(np.square(off).sum(axis=1).mean())


def test_what_one_flight_strayed_by_is_taken_back(planned):
    learned = learn_correction([flown(planned)])
    assert np.abs(left(planned, learned)).max() < 0.003
    largest = np.linalg.norm(straying(planned, np.linspace(0.0, planned.path.end, 200)), axis=1).max()
    assert learned.before == pytest.approx(largest, abs=0.005)
    assert learned.expected < 0.006
    assert not learned.exhausted
    assert np.isnan(learned.unrepeated)


def test_a_corrected_flight_teaches_the_same_as_the_first(planned):
    first = learn_correction([flown(planned)])
    asked = corrected(planned, first.correction)
    slower = Trajectory(asked.path, asked.profile.slowed(0.97), asked.airframe)  # as where it would exceed a limit
    second = flown(planned, slower, seed=1)
    for flights in ([second], [flown(planned), second]):
        learned = learn_correction(flights)
        assert np.abs(left(planned, learned)).max() < 0.003
        assert learned.before < 0.008


def test_a_vehicle_that_lags_and_comes_up_in_the_hover_stays_near_before_and_after(planned):
    """As with more drag than its airframe has; the shift at the end is held while the vehicle comes up."""
    times = np.arange(0.0, planned.duration + 1.5, 0.01)
    share = np.minimum(times, 1.0) * np.exp(-2.0 * np.maximum(times - planned.duration, 0.0))
    lag = -0.05 * share[:, None] * [1.0, 0.0, 0.0]
    flight = EarlierFlight("records/there", planned, planned, times, planned.path(planned.s_at(times)) + lag)
    off = np.linalg.norm(lag + learn_correction([flight]).correction.at(times)[:, 0], axis=1)
    assert off[times < planned.duration - 1.0].max() < 0.015
    assert off.max() < SETTLED


def test_more_flights_bring_the_correction_nearer_to_what_repeats(planned):
    flights = [flown(planned, chance=0.02, seed=seed) for seed in range(8)]
    one, many = learn_correction(flights[:1]), learn_correction(flights)
    assert rms(left(planned, many)) < 0.5 * rms(left(planned, one))
    assert 0.007 < many.unrepeated < 0.035


def test_it_says_when_what_is_left_does_not_repeat(planned):
    flights = [flown(planned, chance=0.01, seed=seed) for seed in range(3)]
    asked = corrected(planned, learn_correction(flights).correction)
    again = flown(planned, asked, chance=0.01, seed=3)
    assert not learn_correction(flights).exhausted
    assert learn_correction([*flights, again]).exhausted
    assert "all that is left" in learn_correction([*flights, again]).describe()


@pytest.mark.parametrize("gap", [(-0.1, 0.4), (2.0, 2.5), (5.9, 9.0)])
def test_a_flight_without_poses_for_a_while_is_refused(planned, gap):
    flight = flown(planned, gap=gap)
    with pytest.raises(InputError, match="no poses for") as refused:
        learn_correction([flight])
    assert refused.value.where == "records/there"
    assert refused.value.hint


def test_a_vehicle_that_strays_too_far_is_refused(planned):
    with pytest.raises(InputError, match="strayed by") as refused:
        learn_correction([flown(planned, more=LARGEST)])
    assert "identify" in refused.value.hint
