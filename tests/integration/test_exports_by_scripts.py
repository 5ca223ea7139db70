"""What is exported of each file of flights/ flies by the scripts of docs/export.md, cflib's and Crazyswarm's.

cflib is unmodified: its Memory, TrajectoryMemory, HighLevelCommander and Localization speak to the virtual Crazyflie of
the stepped lab. Crazyswarm's calls are made of them, as its server makes them: it needs ROS.
"""

import re
import statistics
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from cflib.crazyflie.high_level_commander import HighLevelCommander
from cflib.crazyflie.localization import Localization
from cflib.crazyflie.mem import Memory, MemoryElement, Poly4D
from cflib.crtp.crtpstack import CRTPPacket, CRTPPort
from cflib.utils.callbacks import Caller
from waiting import PATIENCE

from cfplan.errors import CfplanError
from cfplan.flight.on_board.certified_pieces import OnBoardTrajectory
from cfplan.flight.on_board.memory_format import YAW_READ_SINCE
from cfplan.preparation.export_flight import COARSE, Form, fit_polynomials, plan_for_polynomials, write_polynomials
from cfplan.preparation.plan_flight import FlightOptions, PlannedFlight
from cfplan.preparation.prepare_flight import encode_flight
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.lab.lab import Truth
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.simulation.lab.stepped_link import SteppedPoses, connect
from cfplan.vehicle.rotations import yaw_of

REPOSITORY = Path(__file__).parents[2]
PAGE = (REPOSITORY / "docs" / "export.md").read_text()
FLIGHTS = sorted(file.stem for file in (REPOSITORY / "flights").glob("*.yaml"))
TOO_LONG = ("lissajous", "scan")  # for the 31 pieces that Crazyswarm uploads
FLIGHTS_EACH = 5  # a single one strays by chance half a centimetre more than another
COARSELY = {("identify", "by_crazyswarm"): 0.03}  # m: 31 raw pieces follow its 30 s to 17 mm, and leave no correction
WORSE = 0.02  # m, by which the deviation is at most larger than that of the same plan, streamed
HEIGHT = 0.8  # m, of take-off
_READ = load_limits(REPOSITORY / "safety.yaml")
LIMITS = replace(_READ, firmware=replace(_READ.firmware, oldest=YAW_READ_SINCE))


def snippet(heading: str) -> str:
    """The code of a section of the page."""
    return re.search(rf"^## {heading}\n.*?```python\n(.*?)```", PAGE, re.DOTALL | re.MULTILINE)[1]


class Script:
    """The stepped lab as a script sees it: cflib's parts, poses as its motion capture sends them, and time to sleep.

    As cflib has it, the script and what hears the vehicle are in two threads; the lab's time passes in the second one.
    """

    def __init__(self, seed: int) -> None:
        self.lab = SteppedLab(LIMITS.airframe, seed=seed)
        self.began = 0.0  # when the last command of the high-level commander was sent
        self._link = connect(self.lab, lambda message: None)
        self._to_send: deque = deque()
        self._stepped = threading.Condition()
        self.cf = cf = SimpleNamespace(
            send_packet=lambda packet, **_: self._to_send.append(packet), disconnected=Caller(), link=self._link,
            platform=SimpleNamespace(get_protocol_version=lambda: self.lab.vehicle.settings.protocol),
            add_port_callback=self._listen,
        )  # fmt: skip
        cf.high_level_commander, cf.loc, cf.mem = HighLevelCommander(cf), Localization(cf), Memory(cf)
        self._poses = SteppedPoses(self.lab, LIMITS.pose)
        self._poses.open()

    def _listen(self, port: int, note) -> None:
        hear = self.lab.heard

        def hear_too(packet: bytes) -> None:
            hear(packet)
            if packet[0] >> 4 == port:
                note(CRTPPacket(packet[0], packet[1:]))

        self.lab.heard = hear_too

    def run(self, work) -> None:
        """Run work in the script's thread to its end; what it raises is raised."""
        with ThreadPoolExecutor(1) as thread:
            ending = thread.submit(work)
            while not ending.done():
                self.step()
            ending.result()

    def step(self) -> None:
        """Let 10 ms pass, and send the poses of motion capture."""
        for pose in self._poses.poses():
            self.cf.loc.send_extpose(pose.position, pose.quaternion)
        while self._to_send:
            packet = self._to_send.popleft()
            if packet.port == CRTPPort.SETPOINT_HL:
                self.began = self.lab.now
            self._link.send(bytes((packet.header, *packet.data)))
        with self._stepped:
            self.lab.clock.sleep(0.01)
            self._stepped.notify_all()

    def sleep(self, seconds: float) -> None:
        """Let the lab's time pass, in the script's thread."""
        with self._stepped:
            end = self.lab.now + seconds
            assert self._stepped.wait_for(lambda: self.lab.now >= end, PATIENCE)

    def prepare(self) -> None:
        """Set what a flight of these polynomials needs, and converge; in the thread that hears."""
        drag = LIMITS.airframe.drag[0] / LIMITS.airframe.mass
        for name, value in (
            ("stabilizer.controller", 2), ("stabilizer.estimator", 2), ("ctrlMel.mass", LIMITS.airframe.mass),
            ("locSrv.extPosStdDev", 0.003), ("locSrv.extQuatStdDev", 0.01),
            ("kalman.dragB_x", drag), ("kalman.dragB_y", drag), ("kalman.resetEstimation", 1),
        ):  # fmt: skip
            self._link.set_parameter(name, value)


def deviation(truth: Truth, sent: float, wanted, duration: float) -> float:
    """The largest, m, by the best of the delays until what was sent took effect."""
    found = []
    for began in sent + np.arange(0.0, 0.1, 0.005):
        here = (truth.time >= began) & (truth.time < began + duration)
        found.append(np.linalg.norm(truth.position[here] - wanted(truth.time[here] - began), axis=1).max())
    return min(found)


def streamed_deviation(planned: PlannedFlight, seed: int) -> float:
    """Of a plan whose setpoints a script streams, m, with the same settings and poses."""
    encoded, plan, script = encode_flight(planned), planned.plan.trajectory, Script(seed)
    begin = plan.at(np.zeros(1))
    script.prepare()
    script.run(lambda: rise_to(script, *begin.position[0].tolist(), float(yaw_of(begin.quaternion[0]))))
    sent = script.lab.now
    for payload in encoded.payloads:
        script.cf.send_packet(CRTPPacket((CRTPPort.COMMANDER_GENERIC << 4), payload.tobytes()))
        script.step()
    return deviation(script.lab.truth(), sent, lambda time: plan.at(time).position, plan.duration)


def rise_to(script: Script, x: float, y: float, z: float, yaw: float) -> None:
    """Take off, and go where a trajectory begins."""
    script.sleep(2.0)
    script.cf.high_level_commander.takeoff(HEIGHT, 2.0)
    script.sleep(3.0)
    script.cf.high_level_commander.go_to(x, y, z, yaw, 4.0)
    script.sleep(5.0)


class Trajectory:
    """Of Crazyswarm's uav_trajectory: the rows of a CSV, each a duration and four polynomials."""

    def loadcsv(self, name: str) -> None:
        self.rows = np.loadtxt(name, delimiter=",", skiprows=1, usecols=range(33), ndmin=2)


class Crazyswarm:
    """Of Crazyswarm's Crazyflie, what the page calls."""

    def __init__(self, script: Script):
        self._cf, self._pieces = script.cf, 0

    def uploadTrajectory(self, number: int, piece_offset: int, trajectory: Trajectory) -> None:
        (memory,) = self._cf.mem.get_mems(MemoryElement.TYPE_TRAJ)
        memory.trajectory = [
            Poly4D(row[0], *(Poly4D.Poly(row[k : k + 8]) for k in range(1, 33, 8))) for row in trajectory.rows
        ]
        assert memory.write_data_sync(start_addr=132 * piece_offset)
        self._cf.high_level_commander.define_trajectory(number, 132 * piece_offset, len(trajectory.rows))

    def goTo(self, goal, yaw: float, duration: float) -> None:
        self._cf.high_level_commander.go_to(*goal, yaw, duration)

    def startTrajectory(self, number: int, timescale: float = 1.0, reverse=False, relative=True) -> None:
        self._cf.high_level_commander.start_trajectory(number, timescale, relative_position=relative, reversed=reverse)


Fly = Callable[[Script, OnBoardTrajectory], None]


def by_cflib(script: Script, made: OnBoardTrajectory) -> None:
    code = snippet("cflib")
    if made.compressed:
        code, changed = re.subn(r"\(1, 0, pieces\)  # compressed: (\(.*\))", r"\1", code)
        assert changed == 1
    exec(code, {"cf": script.cf, "MemoryElement": MemoryElement, "pieces": len(made.pieces.durations)})


def by_crazyswarm(script: Script, made: OnBoardTrajectory) -> None:
    *start, yaw = made.pieces.coefficients[0, :, 0].tolist()
    names = {"uav_trajectory": SimpleNamespace(Trajectory=Trajectory), "timeHelper": script, "cf": Crazyswarm(script)}
    exec(snippet("Crazyswarm"), names | {"start": start, "yaw": yaw, "duration": 2.0})


def exported_deviation(made: OnBoardTrajectory, fly: Fly, seed: int) -> float:
    """Of polynomials that a script lets the vehicle fly, m; it lands then."""
    script = Script(seed)

    def flight() -> None:
        script.cf.mem.refresh(lambda: None)
        rise_to(script, *made.pieces.coefficients[0, :, 0].tolist())
        fly(script, made)
        script.sleep(made.duration + 0.5)

    script.prepare()
    script.run(flight)
    began = script.began
    script.cf.high_level_commander.land(0.0, 3.0)
    script.run(lambda: script.sleep(5.0))
    truth = script.lab.truth()
    assert truth.position[-1, 2] == 0.0
    assert not truth.locked
    return deviation(truth, began, lambda time: made.reference.plan_at(time)[:, 0, :3], made.duration)


@cache
def planned(name: str) -> PlannedFlight:
    return plan_for_polynomials(REPOSITORY / "flights" / f"{name}.yaml", LIMITS, FlightOptions())


@cache
def streamed(name: str) -> float:
    return statistics.fmean(streamed_deviation(planned(name), seed) for seed in range(FLIGHTS_EACH))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "fly", "form"),
    [
        pytest.param(name, fly, form, id=f"{name} {fly.__name__}")
        for fly, form in ((by_cflib, Form.MEMORY), (by_crazyswarm, Form.CRAZYSWARM))
        for name in FLIGHTS
        if (name, fly) not in [(name, by_crazyswarm) for name in TOO_LONG]
    ],
)
def test_an_export_flies_by_the_script_of_the_page(tmp_path, monkeypatch, name, fly, form):
    monkeypatch.chdir(tmp_path)
    exported = fit_polynomials(planned(name), form)
    write_polynomials(exported, form, tmp_path / ("circle.bin" if form is Form.MEMORY else "circle.csv"))
    flown = statistics.fmean(exported_deviation(exported.on_board, fly, seed) for seed in range(FLIGHTS_EACH))
    print(f"{name} {fly.__name__}: {100 * flown:.1f} cm, {100 * streamed(name):.1f} cm streamed")
    assert flown < streamed(name) + COARSELY.get((name, fly.__name__), WORSE)


@pytest.mark.slow
@pytest.mark.parametrize("name", TOO_LONG)
def test_what_is_too_long_for_crazyswarm_is_refused(name):
    with pytest.raises(CfplanError, match="within 31 pieces"):
        fit_polynomials(planned(name), Form.CRAZYSWARM)


@pytest.mark.slow
def test_what_raw_pieces_follow_coarsely_is_compressed_for_the_memory():
    raw, chosen = (fit_polynomials(planned("identify"), form) for form in (Form.CRAZYSWARM, Form.MEMORY))
    assert raw.on_board.error > COARSE
    assert chosen.on_board.compressed
    assert chosen.on_board.error < raw.on_board.error
    assert chosen.dry_run.deviation < raw.dry_run.deviation
