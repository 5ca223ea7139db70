"""What pip installs is whole: the wheel holds the models and examples, and flies from a folder of its own."""

import os
import pty
import re
import select
import subprocess
import sys
import tomllib
import venv
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from setuptools import find_namespace_packages

from cfplan.errors import InputError
from cfplan.files.shipped import example, shipped_folder

REPOSITORY = Path(__file__).parents[1]


def test_a_wheel_takes_every_model_example_and_layout_along():
    packed = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["setuptools"]["data-files"]
    found = {file for patterns in packed.values() for pattern in patterns for file in REPOSITORY.glob(pattern)}
    wanted = {REPOSITORY / "safety.yaml", *filter(Path.is_file, (REPOSITORY / "flights").rglob("*"))}
    wanted |= set((REPOSITORY / "layouts").iterdir())
    wanted |= {file for file in (REPOSITORY / "models").glob("*/*") if file.suffix in (".safetensors", ".json")}
    assert wanted == found


def test_a_wheel_has_no_studies_and_no_tests():
    found = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]["find"]
    assert {name.partition(".")[0] for name in find_namespace_packages(str(REPOSITORY), **found)} == {"cfplan"}


def test_examples_are_found_by_name_and_listed_where_there_is_none():
    assert example("figure8") == shipped_folder() / "flights" / "figure8.yaml"
    with pytest.raises(InputError, match="there are circle, figure8"):
        example("figure9")


def test_what_runs_on_github_is_what_every_change_must_pass():
    """The same script; what it installs as root for the tests that look at pictures is installed before."""
    folder = REPOSITORY / ".github" / "workflows"
    (checks,) = yaml.safe_load((folder / "checks.yml").read_text())["jobs"].values()
    ran = [step["run"] for step in checks["steps"] if "run" in step]
    assert ran[-1] == ".ci/run"
    script = (REPOSITORY / ".ci" / "run").read_text()
    for package in re.search(r"--no-install-recommends (.*) >", script)[1].split():
        assert package in ran[0] or package == "chromium"  # its machines have that
    (slow,) = yaml.safe_load((folder / "slow.yml").read_text())["jobs"].values()
    assert {"make slow", "make fuzz", ran[0]} <= {step.get("run") for step in slow["steps"]}


def test_who_reports_something_wrong_is_asked_for_what_doctor_prints():
    form = yaml.safe_load((REPOSITORY / ".github" / "ISSUE_TEMPLATE" / "something-is-wrong.yml").read_text())
    (asked,) = [each for each in form["body"] if "cfplan doctor" in each["attributes"]["label"]]
    assert asked["validations"]["required"]


@pytest.mark.slow
@pytest.mark.timeout(1200)  # it downloads and installs what flying needs
def test_a_wheel_in_an_empty_environment_flies_an_example(tmp_path):
    def run(*words: object) -> str:
        environment = {**os.environ, "HOME": str(tmp_path), "PYTHONPATH": ""}
        done = subprocess.run(
            list(map(str, words)), capture_output=True, text=True, cwd=tmp_path, env=environment, check=False
        )
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout + done.stderr

    run(sys.executable, "-m", "build", "--outdir", tmp_path, REPOSITORY)
    venv.create(tmp_path / "env", with_pip=True)
    tools = tmp_path / "env" / "bin"
    (wheel,) = tmp_path.glob("cfplan-*.whl")
    assert f"{wheel.stat().st_size / 1e6:.1f} MB" in (REPOSITORY / "README.md").read_text()
    run(tools / "python", "-m", "pip", "install", "--quiet", wheel)
    assert re.match(r"cfplan \S+, commit [0-9a-f]{12}; models: any \(", run(tools / "cfplan", "--version"))
    said = run(tools / "cfplan", "fly", "--example", "line")
    assert "by learned" in said
    (record,) = (tmp_path / "records").iterdir()
    assert f"record: records/{record.name}" in said


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("terminal", [True, False], ids=["in a terminal", "into a pipe"])
def test_make_fly_in_a_new_clone_lands_and_is_never_silent_for_ten_seconds(tmp_path, terminal):
    """With an environment to be made, and nothing compiled yet."""
    subprocess.run(["git", "clone", "--quiet", REPOSITORY, tmp_path / "cfplan"], check=True)
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    environment |= {"CFPLAN_CACHE": str(tmp_path / "cache"), "TERM": "xterm", "COLUMNS": "80"}
    read, write = pty.openpty() if terminal else os.pipe()
    with subprocess.Popen(
        ["make", "fly"], cwd=tmp_path / "cfplan", env=environment, stdin=subprocess.DEVNULL, stdout=write, stderr=write
    ) as making:
        os.close(write)
        printed = b"".join(pieces_within(read, 10.0))
    assert making.returncode == 0, printed.decode(errors="replace")
    assert b"ended" in printed
    assert b"landed" in printed


def pieces_within(file: int, silence: float) -> Iterator[bytes]:
    """Read to the end; fail where nothing comes for so many seconds."""
    printed = b""
    while True:
        assert select.select([file], [], [], silence)[0], f"silent for {silence} s after {printed[-200:]!r}"
        try:
            printed = os.read(file, 65536)
        except OSError:  # the end of a terminal
            return
        if not printed:
            return
        yield printed
