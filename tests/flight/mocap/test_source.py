"""Poses from a virtual Vicon, and what goes wrong on the way.

What takes its time is tested on the stepped clock, through the same packets. With the driver's process, which only real
time has, tests wait until something has happened and never for how long.
"""

import contextlib
import math
import os
import pickle
import signal
import socket
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import motioncapture
import pytest
from hanging_server import hanging_server
from stepped_vicon import SteppedFeed
from waiting import PATIENCE, a_moment, until

from cfplan.errors import InputError, LinkError
from cfplan.flight.clock import SteppedClock
from cfplan.flight.mocap.child import driver_of
from cfplan.flight.mocap.pose_check import Verdict
from cfplan.flight.mocap.pose_tracker import PoseTracker
from cfplan.flight.mocap.sdk import SdkDriver
from cfplan.flight.mocap.source import OPEN_TIMEOUT, MocapSource, pose_source
from cfplan.flight.mocap.uri import SYSTEMS, parse_uri
from cfplan.safety.limits import PoseLimits
from cfplan.simulation.virtual_vicon.cameras import ViconSettings
from cfplan.simulation.virtual_vicon.faults import FaultKind, ViconFault
from cfplan.simulation.virtual_vicon.vicon import serve

LIMITS = PoseLimits(
    rate=100.0, rate_min=80.0, latency=0.01, age_warning=0.05, age_brake=0.15, age_land=0.5, jump=0.15,
    agreement=0.05, yaw_agreement=0.17,
)  # fmt: skip
BOTH = pytest.mark.parametrize("system", ["vicon", "vicon-sdk"])


def flown(t):
    """A circle at 1 m/s, nose along x."""
    return (math.cos(t), math.sin(t), 1.0), (0.0, 0.0, 0.0, 1.0)


@pytest.fixture
def clock():
    return SteppedClock()


@contextmanager
def stepped(clock, settings, pose=flown, **options):
    """A virtual Vicon and a source of its poses, not opened, on one stepped clock."""
    with serve(settings, pose, clock) as vicon:
        uri = parse_uri(vicon.uri, subject_needed=True)
        source = MocapSource(uri, LIMITS, clock=clock, make_feed=lambda uri: SteppedFeed(uri, clock), **options)
        try:
            yield vicon, source
        finally:
            source.close()


def passed(source, clock, seconds):
    """The poses of so long on the stepped clock, read a hundred times a second."""
    found, end = [], clock.now() + seconds
    while clock.now() < end:
        clock.sleep(0.01)
        found += source.poses()
    return found


@contextmanager
def opened(uri):
    """A source by a real child, opened; its child is gone afterwards."""
    source = pose_source(uri, LIMITS, open_within=PATIENCE)
    source.open()
    child = source.child_id
    try:
        yield source
    finally:
        source.close()
        with pytest.raises(ProcessLookupError):
            os.kill(child, 0)


def silent(source):
    """Whether no pose comes for a moment."""
    a_moment()
    return not source.poses()


@BOTH
def test_a_childs_poses_are_in_order_and_where_the_body_was(system):
    with serve(ViconSettings(position_noise=0, attitude_noise=0), flown) as vicon:
        poses = []
        with opened(vicon.uri_of("cf1", system)) as source:
            assert until(lambda: len(poses) > 40 or poses.extend(source.poses()))
    assert [pose.time for pose in poses] == sorted({pose.time for pose in poses})
    for pose in poses:
        x, y, z = pose.position
        assert (math.hypot(x, y), z) == pytest.approx((1.0, 1.0), abs=1e-6)
        assert pose.received >= pose.time


def test_poses_are_where_and_when_the_body_was(clock):
    with stepped(clock, ViconSettings(position_noise=0, attitude_noise=0)) as (vicon, source):
        source.open()
        poses = passed(source, clock, 5.0)
    assert len(poses) == pytest.approx(500, abs=10)
    assert [pose.time for pose in poses] == sorted({pose.time for pose in poses})
    for pose in poses:  # at 1 m/s; server and client look once a millisecond
        assert math.dist(pose.position, flown(pose.time - vicon.start)[0]) < 0.003
        assert pose.received >= pose.time


@pytest.mark.parametrize(
    ("kind", "verdict"),
    [
        (FaultKind.OCCLUDE, Verdict.OCCLUDED),
        (FaultKind.FREEZE, Verdict.FROZEN),
        (FaultKind.REPEAT, Verdict.REPEATED),
        (FaultKind.JUMP, Verdict.JUMPED),
        (FaultKind.FLIP, Verdict.FLIPPED),
        (FaultKind.BREAK, Verdict.BROKEN),
        (FaultKind.SWAP, Verdict.JUMPED),
    ],
)
def test_a_faulty_pose_is_named_and_never_used(clock, kind, verdict):
    with stepped(clock, ViconSettings(others=(("gate", (3.0, 0.0, 1.0)),))) as (vicon, source):
        tracker = PoseTracker(LIMITS)

        def used(seconds):
            return [pose for pose in passed(source, clock, seconds) if tracker.take(pose) and not tracker.fault]

        def faulty():
            return tracker.verdicts[verdict] + (source.hidden if verdict is Verdict.OCCLUDED else 0)

        source.open()
        assert used(0.5)
        assert faulty() == 0
        vicon.inject(ViconFault(kind, duration=0.8))
        used(0.03)
        assert (source.fault or tracker.fault) == verdict
        assert used(0.75) == []
        assert used(0.1)
        assert (source.fault or tracker.fault) == ""
        assert faulty() == pytest.approx(80, abs=2)


@pytest.mark.parametrize(
    ("kind", "verdict"),
    [(FaultKind.OCCLUDE, Verdict.OCCLUDED), (FaultKind.FREEZE, Verdict.FROZEN), (FaultKind.FLIP, Verdict.FLIPPED)],
)
def test_no_faulty_pose_of_the_vendors_client_is_used_either(kind, verdict):
    tracker = PoseTracker(LIMITS)

    def used():
        return [pose for pose in source.poses() if tracker.take(pose) and not tracker.fault]

    with serve(ViconSettings(), flown) as vicon, opened(vicon.uri_of("cf1", "vicon-sdk")) as source:
        assert until(used)
        vicon.inject(ViconFault(kind))
        assert until(lambda: used() is not None and (source.fault or tracker.fault) == verdict)
        a_moment()
        assert not used()
        vicon.heal()
        assert until(used)


def test_a_delay_makes_poses_old(clock):
    with stepped(clock, ViconSettings()) as (vicon, source):
        source.open()
        passed(source, clock, 3.0)
        assert source.sees_delays
        vicon.inject(ViconFault(FaultKind.DELAY, size=0.2))
        passed(source, clock, 0.25)
        poses = passed(source, clock, 1.0)
    assert len(poses) == pytest.approx(100, abs=2)
    ages = [pose.received - pose.time for pose in poses]
    assert min(ages) > 0.2
    assert max(ages) < 0.22


def test_a_stalled_stream_is_silence_and_comes_back(clock):
    with stepped(clock, ViconSettings()) as (vicon, source):
        source.open()
        vicon.inject(ViconFault(FaultKind.STALL, duration=0.4))
        passed(source, clock, 0.03)
        assert passed(source, clock, 0.37) == []
        assert passed(source, clock, 0.05)


@BOTH
def test_a_connection_that_is_reset_comes_back(system):
    with serve(ViconSettings(), flown) as vicon, opened(vicon.uri_of("cf1", system)) as source:
        vicon.inject(ViconFault(FaultKind.CLOSE))
        assert until(lambda: silent(source))
        vicon.heal()
        assert until(lambda: source.poses())


@BOTH
def test_a_child_that_dies_is_replaced(system):
    with serve(ViconSettings(), flown) as vicon, opened(vicon.uri_of("cf1", system)) as source:
        first = source.child_id
        os.kill(first, signal.SIGKILL)
        assert until(lambda: source.child_id not in (None, first))
        assert until(lambda: source.poses())


def test_a_stopped_child_never_blocks_its_reader():
    with serve(ViconSettings(), flown) as vicon, opened(vicon.uri) as source:
        stopped = source.child_id
        os.kill(stopped, signal.SIGSTOP)
        assert until(lambda: silent(source))
        with contextlib.suppress(ProcessLookupError):  # a child that is silent for too long is replaced
            os.kill(stopped, signal.SIGCONT)
        assert until(lambda: source.poses())


def test_the_child_ends_with_its_parent():
    program = (
        "import os, sys\n"
        "from cfplan.flight.mocap.feed import Feed\n"
        "from cfplan.flight.mocap.uri import SYSTEMS, parse_uri\n"
        "feed = Feed(parse_uri(sys.argv[1], subject_needed=True)); feed.start()\n"
        "while not feed.messages(): pass\n"
        "print(feed.child_id, flush=True)\n"
        "os.kill(os.getpid(), 9)\n"
    )
    with serve(ViconSettings(), flown) as vicon:
        ended = subprocess.run(
            [sys.executable, "-c", program, vicon.uri], capture_output=True, timeout=PATIENCE, check=False
        )
        child = int(ended.stdout)
        assert until(lambda: not Path(f"/proc/{child}").exists())


@BOTH
def test_a_wrong_subject_is_told_with_those_there_are(system):
    settings = ViconSettings(others=(("gate", (3.0, 0.0, 1.0)),))
    with serve(settings, flown) as vicon, pytest.raises(InputError, match="no body named 'cf2'") as caught:
        pose_source(vicon.uri_of("cf2", system), LIMITS).open()
    assert "cf1, gate" in caught.value.hint


def test_a_segment_named_otherwise_is_told_or_does_not_matter():
    with serve(ViconSettings(segment="root"), flown) as vicon:
        with pytest.raises(InputError, match="segment of 'cf1' is named 'root'") as caught:
            pose_source(vicon.uri_of("cf1", "vicon-sdk"), LIMITS).open()
        assert "vicon://" in caught.value.hint
        with opened(vicon.uri) as source:
            assert until(lambda: source.poses())


@pytest.mark.parametrize(
    ("settings", "pose", "words"),
    [
        (ViconSettings(), ((500.0, 200.0, 0.0), (0.0, 0.0, 0.0, 1.0)), "millimetres"),
        (ViconSettings(), ((0.5, 0.2, 0.0), (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))), "y up"),
        (ViconSettings(faults=(ViconFault(FaultKind.OCCLUDE, start=-1.0),)), flown(0), "occluded"),
        (ViconSettings(faults=(ViconFault(FaultKind.BREAK, start=-1.0),)), flown(0), "not a pose"),
        (ViconSettings(position_noise=0.0, attitude_noise=0.0), flown(0), "frozen"),
    ],
    ids=["millimetres", "y up", "hidden", "broken", "paused"],
)
def test_poses_that_cannot_be_flown_by_are_an_error_in_time(clock, settings, pose, words):
    begun = clock.now()
    with stepped(clock, settings, lambda _: pose) as (vicon, source):
        with pytest.raises((InputError, LinkError), match=words) as caught:
            source.open()
        assert clock.now() - begun < OPEN_TIMEOUT + 0.1
    assert caught.value.hint
    assert caught.value.where == vicon.uri


def test_a_system_that_sends_nothing_is_an_error():
    stalled = ViconSettings(faults=(ViconFault(FaultKind.STALL, start=-1.0),))
    with serve(stalled, flown) as vicon, pytest.raises(LinkError, match="nothing came") as caught:
        pose_source(vicon.uri, LIMITS, open_within=PATIENCE).open()
    assert caught.value.hint
    assert caught.value.where == vicon.uri


def test_a_vendors_client_that_hangs_is_ended():
    with hanging_server(then_close=True) as uri, pytest.raises(LinkError, match="no answer"):
        pose_source(uri, LIMITS, open_within=PATIENCE).open()


def test_a_missing_package_is_told_with_its_remedy(tmp_path, monkeypatch):
    (tmp_path / "motioncapture.py").write_text("raise ImportError('not here')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(InputError, match="not installed") as caught:
        pose_source("qualisys://127.0.0.1/cf1", LIMITS).open()
    assert "cfplan[mocap]" in caught.value.hint


def test_the_other_systems_say_so_where_nobody_is():
    with pytest.raises(LinkError, match="refused"):
        pose_source("qualisys://127.0.0.1:9/cf1", LIMITS).open()


@pytest.mark.parametrize("system", ["optitrack", "optitrack-sdk", "qualisys", "vrpn", "nokov", "motionanalysis"])
def test_every_client_gets_the_address_of_a_computer_that_is_named(monkeypatch, system):
    got = {}
    monkeypatch.setattr(motioncapture, "connect", lambda kind, settings: got.update(settings, kind=kind))
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = f":{server.getsockname()[1]}" if SYSTEMS[system] else ""
        SdkDriver(parse_uri(f"{system}://localhost{port}/cf1", subject_needed=True)).connect()
    assert got["hostname"].split(":")[0] == "127.0.0.1"
    assert got["kind"] == {"optitrack-sdk": "optitrack_closed_source"}.get(system, system)


@pytest.mark.parametrize("system", sorted(SYSTEMS))
def test_a_computer_that_nobody_knows_is_an_error_of_every_system(system):
    uri = parse_uri(f"{system}://nowhere.invalid/cf1", subject_needed=True)
    with pytest.raises(InputError, match=r"no computer named 'nowhere.invalid'"):
        driver_of(uri).connect()


@pytest.mark.parametrize("system", ["optitrack-sdk", "nokov", "motionanalysis"])
def test_a_system_without_which_the_package_is_built_is_named(system):
    with pytest.raises(InputError, match=f"built without {system}") as caught:
        SdkDriver(parse_uri(f"{system}://127.0.0.1/cf1", subject_needed=True)).connect()
    assert "from source" in caught.value.hint


def test_a_source_goes_to_another_process():
    source = pickle.loads(pickle.dumps(pose_source("vicon://127.0.0.1/cf1", LIMITS)))
    assert source.poses() == []
    source.close()


def test_errors_survive_the_pipe_and_the_pickle():
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    with pytest.raises(LinkError, match="refused") as caught:
        pose_source(f"vicon://127.0.0.1:{port}/cf1", LIMITS).open()
    assert pickle.loads(pickle.dumps(caught.value)).hint == caught.value.hint
