"""`--example NAME` stands for a path that comes with cfplan."""

import pytest


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["check"], "Missing argument 'PATH_OR_PLAN' (or --example)"),
        (["sim", "--example", "line", "flights/line.yaml"], "both a path and an example"),
        (["fly"], "neither a path nor waypoints"),
        (["fly", "--example", "line", "--uri", "radio://0/80/2M/E7E7E7E7E7"], "only with an explicit safety.yaml"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_what_is_no_example_is_refused_in_words(cfplan, words, said):
    ended = cfplan(*words)
    assert ended.code == 2
    assert said in ended.err


def test_an_example_is_planned_where_its_own_limits_are(cfplan, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    document = cfplan("plan", "--example", "line", "-o", "line.parquet", "--json").json
    assert document["certificate"]["passed"]
    assert (tmp_path / "line.parquet").is_file()
