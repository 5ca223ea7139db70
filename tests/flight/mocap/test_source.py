"""Poses through a real child process from a virtual Vicon, and what goes wrong on the way."""

import math
import os
import pickle
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from cfplan.errors import InputError, LinkError
from cfplan.flight.mocap.datastream import Block, kinds, packet
from cfplan.flight.mocap.pose_classifier import Verdict
from cfplan.flight.mocap.source import pose_source
from cfplan.safety.limits import PoseLimits
from cfplan.simulation.virtual_vicon.cameras import ViconSettings
from cfplan.simulation.virtual_vicon.faults import FaultKind, ViconFault
from cfplan.simulation.virtual_vicon.vicon import serve

pytestmark = pytest.mark.integration

LIMITS = PoseLimits(
    rate=100.0, rate_min=80.0, latency=0.01, age_warning=0.05, age_brake=0.15, age_land=0.5, jump=0.15,
    agreement=0.05, yaw_agreement=0.17,
)  # fmt: skip
BOTH = pytest.mark.parametrize("system", ["vicon", "vicon-sdk"])
PATIENCE = 10.0  # s that a machine under load may take for what takes a fraction of it


def flown(t):
    """A circle at 1 m/s, nose along x."""
    return (math.cos(t), math.sin(t), 1.0), (0.0, 0.0, 0.0, 1.0)


@contextmanager
def opened(uri):
    """A source, opened; its child is gone afterwards."""
    source = pose_source(uri, LIMITS)
    source.open()
    child = source.child_id
    try:
        yield source
    finally:
        source.close()
        with pytest.raises(ProcessLookupError):
            os.kill(child, 0)


def gathered(source, seconds):
    """The poses of so long."""
    found, end = [], time.monotonic() + seconds
    while time.monotonic() < end:
        found += source.poses()
        time.sleep(0.005)
    return found


def until(condition, patience=PATIENCE):
    """Wait for it; whether it came."""
    end = time.monotonic() + patience
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.005)
    return False


@BOTH
def test_poses_are_where_and_when_the_body_was(system):
    with serve(ViconSettings(position_noise=0, attitude_noise=0), flown) as vicon:
        with opened(vicon.uri_of("cf1", system)) as source:
            poses = gathered(source, 0.7)
        assert len(poses) > 40
        assert [pose.time for pose in poses] == sorted({pose.time for pose in poses})
        # Where the body was at a pose's date, to what a late wake-up of a process costs at 1 m/s; most are on time.
        off = sorted(math.dist(pose.position, flown(pose.time - vicon.start)[0]) for pose in poses)
        assert off[len(off) // 2] < 0.01
        assert all(pose.received >= pose.time for pose in poses)


def test_no_more_poses_than_the_rate_allows():
    with serve(ViconSettings(rate=300.0), flown) as vicon, opened(vicon.uri) as source:
        poses = gathered(source, 1.0)
    assert len(poses) > 50
    span = poses[-1].time - poses[0].time
    assert (len(poses) - 2) / span < 1.25 * LIMITS.rate
    assert source.counts[Verdict.GOOD] > 1.5 * len(poses)


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
def test_a_faulty_pose_is_named_and_never_comes_out(kind, verdict):
    with serve(ViconSettings(others=(("gate", (3.0, 0.0, 1.0)),)), flown) as vicon, opened(vicon.uri) as source:
        assert source.counts[verdict] == 0
        vicon.inject(ViconFault(kind, duration=0.8))
        assert until(lambda: source.poses() is not None and source.fault == verdict)
        assert gathered(source, 0.1) == []
        assert until(lambda: source.poses())
        assert source.fault == ""
        assert source.counts[verdict] >= 20


@pytest.mark.parametrize(
    ("kind", "verdict"),
    [(FaultKind.OCCLUDE, Verdict.OCCLUDED), (FaultKind.FREEZE, Verdict.FROZEN), (FaultKind.FLIP, Verdict.FLIPPED)],
)
def test_the_vendors_client_gives_no_faulty_pose_either(kind, verdict):
    with serve(ViconSettings(), flown) as vicon, opened(vicon.uri_of("cf1", "vicon-sdk")) as source:
        vicon.inject(ViconFault(kind, duration=0.8))
        assert until(lambda: source.poses() is not None and source.fault == verdict)
        assert gathered(source, 0.1) == []
        assert until(lambda: source.poses())


def test_a_delay_makes_poses_old():
    with serve(ViconSettings(), flown) as vicon, opened(vicon.uri) as source:
        assert until(lambda: source.poses() is not None and source.sees_delays)
        vicon.inject(ViconFault(FaultKind.DELAY, size=0.2))
        gathered(source, 0.4)
        poses = gathered(source, 0.3)
    assert poses
    assert min(pose.received - pose.time for pose in poses) > 0.2


def test_a_stalled_stream_is_silence_and_comes_back():
    with serve(ViconSettings(), flown) as vicon, opened(vicon.uri) as source:
        vicon.inject(ViconFault(FaultKind.STALL, duration=0.4))
        gathered(source, 0.15)
        assert gathered(source, 0.1) == []
        assert until(lambda: source.poses())


@BOTH
def test_a_connection_that_is_reset_comes_back(system):
    with serve(ViconSettings(), flown) as vicon, opened(vicon.uri_of("cf1", system)) as source:
        vicon.inject(ViconFault(FaultKind.CLOSE, duration=0.4))
        gathered(source, 0.2)
        assert gathered(source, 0.1) == []
        assert until(lambda: source.poses())


@BOTH
def test_a_child_that_dies_is_replaced(system):
    with serve(ViconSettings(), flown) as vicon, opened(vicon.uri_of("cf1", system)) as source:
        first = source.child_id
        os.kill(first, signal.SIGKILL)
        gathered(source, 0.1)
        assert until(lambda: source.poses())
        assert source.child_id != first


def test_a_stopped_child_never_blocks_its_reader():
    with serve(ViconSettings(), flown) as vicon, opened(vicon.uri) as source:
        os.kill(source.child_id, signal.SIGSTOP)
        gathered(source, 0.1)
        assert gathered(source, 0.1) == []
        os.kill(source.child_id, signal.SIGCONT)
        assert until(lambda: source.poses())


def test_the_child_ends_with_its_parent():
    program = (
        "import os, sys\n"
        "from cfplan.flight.mocap.feed import Feed\n"
        "from cfplan.flight.mocap.uri import parse_uri\n"
        "feed = Feed(parse_uri(sys.argv[1], subject_needed=True)); feed.start()\n"
        "while not feed.messages(): pass\n"
        "print(feed.child_id, flush=True)\n"
        "os.kill(os.getpid(), 9)\n"
    )
    with serve(ViconSettings(), flown) as vicon:
        ended = subprocess.run([sys.executable, "-c", program, vicon.uri], capture_output=True, timeout=30, check=False)
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
            assert gathered(source, 0.2)


@pytest.mark.parametrize(
    ("settings", "pose", "words"),
    [
        (ViconSettings(), ((500.0, 200.0, 0.0), (0.0, 0.0, 0.0, 1.0)), "millimetres"),
        (ViconSettings(), ((0.5, 0.2, 0.0), (math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5))), "y up"),
        (ViconSettings(faults=(ViconFault(FaultKind.OCCLUDE, start=-1.0),)), flown(0), "occluded"),
        (ViconSettings(faults=(ViconFault(FaultKind.BREAK, start=-1.0),)), flown(0), "not a pose"),
        (ViconSettings(position_noise=0.0, attitude_noise=0.0), flown(0), "frozen"),
        (ViconSettings(faults=(ViconFault(FaultKind.STALL, start=-1.0),)), flown(0), "nothing came"),
    ],
    ids=["millimetres", "y up", "hidden", "broken", "paused", "stalled"],
)
def test_poses_that_cannot_be_flown_by_are_an_error_in_time(settings, pose, words):
    with serve(settings, lambda _: pose) as vicon, pytest.raises((InputError, LinkError), match=words) as caught:
        pose_source(vicon.uri, LIMITS, open_within=1.6).open()
    assert caught.value.hint
    assert caught.value.where == vicon.uri


@contextmanager
def trap(then_close):
    """A server that welcomes clients and never sends a frame; it may stop listening after the first."""
    listener = socket.create_server(("127.0.0.1", 0))
    clients = []

    def run():
        try:
            while True:
                client, _ = listener.accept()
                clients.append(client)
                client.sendall(packet((Block.OBJECT_ENUMS, kinds([2, 5, 9]))))
                if then_close:
                    listener.close()
                    client.close()
        except OSError:
            return

    threading.Thread(target=run, daemon=True).start()
    try:
        yield f"vicon-sdk://127.0.0.1:{listener.getsockname()[1]}/cf1"
    finally:
        listener.close()
        for client in clients:
            client.close()


@pytest.mark.parametrize("then_close", [False, True], ids=["no frame", "looks for its server for ever"])
def test_a_vendors_client_that_hangs_is_ended_in_time(then_close):
    with trap(then_close) as uri:
        begun = time.monotonic()
        with pytest.raises(LinkError, match=r"no answer|no frame"):
            pose_source(uri, LIMITS).open()
        assert time.monotonic() - begun < 5.0


def test_a_missing_package_is_told_with_its_remedy(tmp_path, monkeypatch):
    (tmp_path / "motioncapture.py").write_text("raise ImportError('not here')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with pytest.raises(InputError, match="not installed") as caught:
        pose_source("qualisys://127.0.0.1/cf1", LIMITS).open()
    assert "cfplan[mocap]" in caught.value.hint


def test_the_other_systems_say_so_where_nobody_is():
    with pytest.raises(LinkError, match="refused"):
        pose_source("qualisys://127.0.0.1:9/cf1", LIMITS).open()


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
