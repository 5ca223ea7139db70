"""`python -m studies`: options are derived from settings, and an unknown study is answered with the known ones."""

from dataclasses import dataclass
from pathlib import Path

import click
import pytest
from click.testing import CliRunner

from cfplan.errors import InputError
from cfplan.geometry.yaw import YawMode
from studies import STUDIES
from studies.runner.commands import studies
from studies.runner.options import argument, option, parameters, settings_of


@dataclass(frozen=True)
class Settings:
    path_files: tuple[Path, ...] = argument()
    paths: int = option(100, "Random paths.", least=1)
    boxes: tuple[str, ...] = option(("small", "large"), "Box.", choices=("small", "large"))
    yaw: YawMode = option(YawMode.FREE, "Yaw mode.")
    longest: float | None = option(None, "Length, m.", least=0.0)
    quick: bool = option(False, "Run a few.")


def parsed(*words):
    found = []
    callback = lambda **given: found.append(settings_of(Settings, given))  # noqa: E731
    for parameter in reversed([*parameters(Settings)]):
        callback = parameter(callback)
    result = CliRunner().invoke(click.command("some")(callback), words)
    return found[0] if found else result.output


def test_options_left_out_keep_their_defaults():
    assert parsed("a.yaml") == Settings((Path("a.yaml"),))


def test_options_that_are_given_are_settings():
    words = ["a.yaml", "b.yaml", "--paths", "3", "--box", "small", "--yaw", "tangent", "--longest", "2.5", "--quick"]
    expected = Settings((Path("a.yaml"), Path("b.yaml")), 3, ("small",), YawMode.TANGENT, 2.5, True)
    assert parsed(*words) == expected


@pytest.mark.parametrize("words", ["", "a --paths 0", "a --box huge", "a --yaw sideways", "a --longest -1"])
def test_what_settings_exclude_is_refused(words):
    assert "Error" in parsed(*words.split())


def test_help_gives_each_option_with_its_default():
    shown = " ".join(parsed("--help").split())
    for text in ("PATH...", "Random paths.", "[default: 100", "[default: small, large]", "fixed|tangent|free"):
        assert text in shown


def test_an_unknown_study_is_refused_with_all_that_there_are():
    result = CliRunner().invoke(studies, ["nonsense"], standalone_mode=False)
    assert isinstance(result.exception, InputError)
    assert "did you mean" not in result.exception.hint
    assert {*STUDIES} <= {*result.exception.hint.replace(",", " ").split()}


def test_a_mistyped_study_is_answered_with_the_nearest():
    result = CliRunner().invoke(studies, ["fault"], standalone_mode=False)
    assert result.exception.hint.startswith("did you mean faults? known: ")


@pytest.mark.parametrize("name", sorted(STUDIES))
def test_every_study_has_a_command_whose_help_begins_with_what_it_measures(name):
    result = CliRunner().invoke(studies, [name, "--help"])
    assert result.exit_code == 0, result.output
    assert f"python -m studies {name}" in " ".join(result.output.split())
    assert all(f"--{each}" in result.output for each in ("workers", "scheduler", "minutes", "output"))


def test_help_lists_every_study():
    listed = CliRunner().invoke(studies, ["--help"]).output
    assert all(f"  {name} " in listed for name in STUDIES)


def test_an_output_in_a_folder_that_is_not_there_is_refused_before_anything_is_measured(tmp_path):
    words = ["dry-runs", "flights/line.yaml", "-o", str(tmp_path / "none" / "r.json")]
    result = CliRunner().invoke(studies, words, standalone_mode=False)
    assert isinstance(result.exception, InputError)
    assert "no such folder" in str(result.exception)
