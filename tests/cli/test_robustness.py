"""`cfplan robustness`: a table for people, one document for scripts, and what is refused."""

from pathlib import Path

LINE = Path(__file__).parents[2] / "flights" / "line.yaml"
TOO_FAR = ("robustness", LINE, "--epsilon", "3", "--draws", "1")  # moved by metres it leaves the room


def test_what_is_refused_says_why(cfplan):
    ended = cfplan(*TOO_FAR, "--json")
    assert ended.code == 0, ended.err
    (scale,), (plan,) = ended.json["scales"], ended.json["plans"]
    assert "space" in plan["reason"]
    assert (scale["epsilon"], scale["plans"], scale["certified"], scale["longer"]) == (3.0, 1, 0, None)


def test_people_get_a_table_and_each_reason_once(cfplan):
    ended = cfplan(*TOO_FAR)
    assert ended.code == 0, ended.err
    assert "300 cm" in ended.out
    assert "0/1" in ended.out
    assert ended.out.count("refused: ") == 1
