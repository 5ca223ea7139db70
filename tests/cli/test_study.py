"""`cfplan study`: an unknown study is answered with those that there are."""

from click.testing import CliRunner

from cfplan.cli import cfplan
from cfplan.errors import InputError


def test_an_unknown_study_is_refused_with_all_that_there_are():
    result = CliRunner().invoke(cfplan, ["study", "nonsense"], standalone_mode=False)
    assert isinstance(result.exception, InputError)
    assert "'nonsense'" in result.exception.what
    assert "did you mean" not in result.exception.hint
    for name in ("architectures", "baselines", "paper", "physics", "docs"):
        assert name in result.exception.hint.replace(",", " ").split()


def test_a_mistyped_study_is_answered_with_the_nearest():
    result = CliRunner().invoke(cfplan, ["study", "fault"], standalone_mode=False)
    assert result.exception.hint.startswith("did you mean faults? known: ")


def test_help_says_of_each_study_what_it_measures():
    lines = CliRunner().invoke(cfplan, ["study", "--help"]).output.split("Commands:")[1]
    assert "..." not in lines
