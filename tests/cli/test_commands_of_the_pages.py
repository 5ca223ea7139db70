"""Every command that README and docs/ show is one that cfplan takes, and is run by a test: these, and those it names.

Here commands run as they stand, in a new folder, with records where they are shown. Flights go by the stepped clock,
those on hardware by another URI alone: that of the virtual lab. No window is opened.
"""

import io
import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
import threading
from functools import partial
from glob import glob
from pathlib import Path

import click
import pages
import pytest
import rerun as rr
from pages import AS_SHOWN, BY_CI, COMPLETED, FLOWN, STEERED
from scipy.spatial.transform import Rotation
from stepped_flight import fly_stepped

from cfplan.cli import cfplan as command_line
from cfplan.planning.plan_file import save_plan
from cfplan.preparation.prepare_flight import prepare_flight
from cfplan.recording.header import header_of_plan
from cfplan.recording.reader import read_record
from cfplan.recording.rerun.live import LiveView
from cfplan.recording.summary import summarise
from cfplan.recording.writer import RecordWriter, write_summary
from cfplan.safety.limits_file import load_limits
from cfplan.simulation.lab.stepped_lab import SteppedLab
from cfplan.steering import connect
from tests.recording.importers.test_import_vicon import write as write_vicon_csv

REPOSITORY = Path(__file__).parents[2]
RECORD = re.compile(r"records/[\w<>-]+")
ON_HARDWARE = (("radio://0/80/2M/E7E7E7E7E7", "sim://0"), ("vicon://192.168.1.2/cf1", "vicon://lab/cf1"))
SLOW = (
    "/scan.yaml", "/circle.yaml --to", "--gif", "--png", "replay records/20261122-212927-figure-eight --figure",
    "--on-board", "fly flights/identify.yaml", "--warm-up", "/six.yaml", "export flights/fleets",
    "fly flights/figure8.yaml", "fly mine.parquet", "fly path.yaml", "--speed 0.3", "--figure plan.pdf",
    "export mylab/first.yaml", "-o comparison.html",
)  # fmt: skip
DRIVERS = [*Path("/usr/share/vulkan/icd.d").glob("lvp_icd*.json"), *Path("/etc/vulkan/icd.d").glob("lvp_icd*.json")]
no_driver = pytest.mark.skipif(not DRIVERS, reason="no software Vulkan driver (Debian: mesa-vulkan-drivers)")


def parameters(lines):
    """Return the lines to run, of which some are slow, and some need a driver."""
    for line in lines:
        slow = [pytest.mark.slow] * any(part in line for part in SLOW)
        yield pytest.param(line, marks=[*slow, *[no_driver] * ("--png" in line)])


@pytest.mark.parametrize("page", pages.PAGES, ids=lambda page: page.relative_to(REPOSITORY).as_posix())
def test_every_command_of_a_page_is_run_by_a_test(page):
    for _, line, _ in [shown for shown in pages.shown_commands() if REPOSITORY / shown.page == page]:
        test = pages.run_by(line)
        assert test is not None, f"no test runs {line!r}: write one, and name it in tests/pages.py"
        file, _, name = test.partition("::")
        text = (REPOSITORY / file).read_text()
        if test == BY_CI:
            assert all(f"make {goal}\n" in text for goal in line.split()[1:])
        else:
            assert f"def {name}(" in text


@pytest.mark.parametrize("line", sorted({shown.line for shown in pages.shown_commands() if shown.whole}))
def test_a_whole_command_is_one_that_cfplan_takes(folder, monkeypatch, line):
    """Its arguments are there, known, of their type and in their range; nothing is run."""
    if not line.startswith("cfplan ") or "--help" in line:
        return
    monkeypatch.chdir(folder)
    (folder / "records" / "<flight>").mkdir(parents=True, exist_ok=True)
    command: click.Command = command_line
    words = [word for part in shlex.split(line)[1:] for word in sorted(glob(part)) or [part]]
    while isinstance(command, click.Group):
        found = command.get_command(click.Context(command), words.pop(0))
        assert found is not None
        command = found
    command.make_context(line, words)


@pytest.mark.parametrize("page", pages.PAGES, ids=lambda page: page.name)
def test_goals_of_make_and_tests_that_a_page_names_are_there(page):
    text, makefile = page.read_text(), (REPOSITORY / "Makefile").read_text()
    goals = {goal for span in re.findall(r"(?:`| {4})make ([a-z ]+?)(?=`|  |$)", text, re.M) for goal in span.split()}
    assert all(re.search(rf"^{goal}:", makefile, re.M) for goal in goals), goals
    for span in re.findall(r"`(?:[\w./]*python -m )?pytest ([^`]+)`", text):
        assert all((REPOSITORY / word).exists() for word in span.split() if word.startswith("tests"))


@pytest.fixture(scope="module")
def record(tmp_path_factory):
    """The record of a flight in the stepped lab, with its plan and summary as `cfplan fly` leaves them."""
    folder = tmp_path_factory.mktemp("flown") / "record"
    source = REPOSITORY / "flights" / "figure8.yaml"
    prepared = prepare_flight(source, load_limits(REPOSITORY / "safety.yaml"))
    lab = SteppedLab(prepared.mission.limits.airframe)
    header = header_of_plan(prepared.plan, name="figure8", uri="stepped://0", source=source, wall_time_at_zero=1.7e9)
    with RecordWriter(folder, header, clock=lab.clock) as writer:
        outcome = fly_stepped(prepared.mission, writer.write, lab=lab).outcome
    assert outcome.reason == "landed"
    save_plan(prepared.plan, folder / "plan.parquet", {"name": "figure8", "path file": str(source)})
    write_summary(folder, {"outcome": outcome.to_dict(), **summarise(read_record(folder)).to_json()})
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A new folder with what the repository brings, a path and a plan of one's own, and a model."""
    folder = tmp_path_factory.mktemp("shown")
    for name in ("examples", "flights", "results"):
        shutil.copytree(REPOSITORY / name, folder / name)
    shutil.copy(REPOSITORY / "safety.yaml", folder)
    for name in ("path.yaml", "first.yaml"):
        shutil.copy(REPOSITORY / "flights" / "line.yaml", folder / name)
    shutil.copytree(REPOSITORY / "models" / "any", folder / "models" / "mine")
    return folder


def prepare(line, folder, request):
    """Lay in the folder what a command reads beside paths and limits."""
    run = request.getfixturevalue("cfplan")
    if "mylab/first.yaml" in line and not (folder / "mylab").is_dir():
        assert run("init", "mylab", "--room", "4x6x2.5").code == 0
    if "mine.parquet" in line:
        assert run("plan", "path.yaml", "-o", "mine.parquet").code == 0
    for name in RECORD.findall(line) or ["records/20261122-094221-figure8"] * (line == "cfplan replay records"):
        if not (folder / name / "flight.mcap").is_file():
            shutil.copytree(request.getfixturevalue("record"), folder / name, dirs_exist_ok=True)
    if "vicon.csv" in line:
        poses = read_record(request.getfixturevalue("record")).poses
        seen = [True] * len(poses.time)
        motion = (poses.position, Rotation.from_quat(poses.quaternion), seen)
        write_vicon_csv(folder / "vicon.csv", {"cf1": ("quaternion", motion)}, rate=100.0, length="mm")


@pytest.fixture
def no_window(monkeypatch):
    """Send what a viewer's window would show into memory."""
    for module in ("viewer", "live"):
        monkeypatch.setattr(f"cfplan.recording.rerun.{module}.require_screen", lambda hint: None)
    monkeypatch.setattr("rerun.spawn", lambda *, recording, **_: recording.memory_recording())

    def open_live(header, folder):
        stream = rr.RecordingStream("cfplan")
        stream.memory_recording()
        return LiveView(stream, header, folder)

    monkeypatch.setattr("cfplan.recording.rerun.live.open_live", open_live)


@pytest.mark.parametrize("line", list(parameters(pages.lines_for(AS_SHOWN))))
def test_a_command_ends_well_as_it_is_shown(cfplan, folder, tmp_path, monkeypatch, request, no_window, line):
    monkeypatch.chdir(tmp_path if " init" in line else folder)
    prepare(line, folder, request)
    if line.startswith("python"):
        words = [sys.executable, *shlex.split(line.replace("…", "--help"))[1:]]
        environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
        assert b"Usage" in subprocess.run(words, capture_output=True, check=True, env=environment).stdout
        return
    words = shlex.split(line)[1:]
    if {"-o", "--figure", "--gif", "--png", "--save"} & set(words) or words[0] == "report":
        words.append("--force")
    ended = cfplan(*words)
    assert ended.code == 0, ended.err


class SteppedVehicle:
    """In place of the processes of pilot and lab."""

    def __init__(self, uri, mocap_uri, limits):
        assert uri == "sim://0"
        self.uri, self.pilot = uri, None

    def poses(self, steps):
        return None

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass


def fly_in_the_stepped_lab(mission, *, on_telemetry, more_orders, **_):
    return fly_stepped(mission, on_telemetry, more_orders=more_orders).outcome


@pytest.mark.parametrize("line", list(parameters(pages.lines_for(FLOWN))))
def test_a_flight_lands_as_it_is_shown(cfplan, folder, tmp_path, monkeypatch, request, no_window, line):
    monkeypatch.chdir(folder)
    monkeypatch.setattr("cfplan.steering.starting_vehicle.StartingVehicle", SteppedVehicle)
    monkeypatch.setattr("cfplan.cli.recorded_flight.fly", fly_in_the_stepped_lab)
    prepare(line, folder, request)
    for shown, virtual in ON_HARDWARE:
        line = line.replace(shown, virtual)
    ended = cfplan(*shlex.split(line)[1:], "--records", tmp_path)
    assert ended.code == 0, ended.err
    assert re.search(r"ended +landed", ended.out)
    (flight,) = tmp_path.iterdir()
    assert f"replay: cfplan replay {flight}" in ended.out


@pytest.mark.parametrize("line", pages.lines_for(STEERED))
def test_waypoints_are_flown_as_it_is_shown(cfplan, folder, tmp_path, monkeypatch, no_window, line):
    monkeypatch.chdir(folder)
    by_clock = partial(connect.connect, stepped=True)
    monkeypatch.setattr(connect, "connect", by_clock)
    asked = b"1 0 1\n0 1 1.2\n"
    monkeypatch.setattr("sys.stdin", io.TextIOWrapper(io.BytesIO(asked)))
    if found := re.search(r"unix:(\S+)", line):
        threading.Thread(target=ask_by_the_socket, args=(folder / found[1], asked), daemon=True).start()
    ended = cfplan(*shlex.split(line)[1:], "--records", tmp_path)
    assert ended.code in (0, 6), ended.err
    assert ended.out.count("accepted") == (0 if found else 2)
    (flight,) = tmp_path.iterdir()
    assert len(list(flight.glob("plan-*.parquet"))) > 0


def ask_by_the_socket(path, lines):
    while True:
        with socket.socket(socket.AF_UNIX) as client:
            client.settimeout(60)
            try:
                client.connect(str(path))
            except OSError:  # it is not there yet
                continue
            answers = client.makefile("rb")
            client.sendall(lines)
            assert all(b"accepted" in answers.readline() for _ in lines.splitlines())
            client.sendall(b"land\n")
            assert b"accepted" in answers.readline()
            return


@pytest.mark.parametrize("line", pages.lines_for(COMPLETED))
def test_completion_is_set_up_as_it_is_shown(tmp_path, line):
    """In the shell that it is for where that is here; else the script is made at least."""
    wanted = re.search(r"_CFPLAN_COMPLETE=(\w+)_source", line)[1]
    shell = shutil.which(wanted)
    program = tmp_path / "bin" / "cfplan"
    program.parent.mkdir()
    program.write_text(f"#!{sys.executable}\nfrom cfplan.cli import main\nmain()\n")
    program.chmod(0o755)
    (tmp_path / ".config" / "fish" / "completions").mkdir(parents=True)
    environment = {**os.environ, "HOME": str(tmp_path), "PATH": f"{program.parent}:{os.environ['PATH']}"}
    environment["PYTHONPATH"] = str(REPOSITORY)
    if shell is None:
        line = re.sub(r'^eval "\$\((.*)\)"$', r"\1", line)
    done = subprocess.run(
        [shell or "bash", "-c", line], env=environment, capture_output=True, text=True, check=False
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    scripts = list((tmp_path / ".config").rglob("*.fish"))
    if shell is None or scripts:
        assert "_CFPLAN_COMPLETE" in "".join(script.read_text() for script in scripts) or done.stdout


def test_the_commands_of_the_first_hour_and_after_a_flight_are_among_them():
    commands = {"init", "plan", "check", "sim", "export", "replay", "report", "identify", "doctor"}
    assert commands <= {line.split()[1] for line in pages.lines_for(AS_SHOWN)}
    assert len(pages.lines_for(AS_SHOWN)) > 30
    assert len(pages.lines_for(FLOWN)) > 10


@pytest.mark.parametrize("words", [[name] for name in sorted(command_line.commands)])
def test_every_command_explains_itself(cfplan, words):
    ended = cfplan(*words, "--help")
    assert ended.code == 0
    assert ended.out.startswith(f"Usage: cfplan {' '.join(words)} ")


def test_a_computer_is_examined_as_json(cfplan, monkeypatch):
    monkeypatch.chdir(REPOSITORY)
    ended = cfplan("doctor", "--json")
    assert ended.json, ended.err
