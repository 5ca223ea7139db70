"""The strict YAML reader: what it reads, and how it reports what it refuses."""

import pathlib

import pytest
from pydantic import BaseModel, ConfigDict, Field

from cfplan.errors import InputError
from cfplan.files.yaml_with_places import read_yaml, read_yaml_with_places
from cfplan.geometry.path_file import load_path_file
from cfplan.geometry.yaw import YawMode


class Box(BaseModel):
    model_config = ConfigDict(extra="forbid")

    low: tuple[float, float]
    margin: float = Field(default=0.1, ge=0)


class Room(BaseModel):
    model_config = ConfigDict(extra="forbid")

    name: str
    box: Box
    mode: YawMode = YawMode.FIXED
    count: int = 1
    open: bool = False
    note: str | None = None


GOOD = "name: lab\nbox:\n  low: [-1, 2.5e-1]\n  margin: 0.2\nmode: tangent\nopen: true\n"


@pytest.fixture
def read(tmp_path):
    def run(content: str | bytes) -> Room:
        file = tmp_path / "room.yaml"
        file.write_bytes(content if isinstance(content, bytes) else content.encode())
        return read_yaml(file, Room)

    return run


def test_a_good_file_is_its_model(read):
    room = read(GOOD)
    assert room == Room(name="lab", box=Box(low=(-1.0, 0.25), margin=0.2), mode=YawMode.TANGENT, open=True)


def test_a_byte_order_mark_and_windows_line_ends_are_taken(read):
    assert read(b"\xef\xbb\xbf" + GOOD.replace("\n", "\r\n").encode()).box.margin == 0.2


@pytest.mark.parametrize("text", ["1e-3", "1E-3", "0.001", ".001", "+1.0e-3"])
def test_numbers_are_what_they_look_like(read, text):
    assert read(GOOD.replace("0.2", text)).box.margin == 0.001


@pytest.mark.parametrize("name", ["yes", "12:30", "2024-01-01", "0x10", "1_000", "'3'", '"null"'])
def test_words_stay_words(read, name):
    assert read(GOOD.replace("lab", name)).name == name.strip("'\"")


def test_places_are_those_of_the_file(tmp_path):
    file = tmp_path / "room.yaml"
    file.write_text(GOOD)
    _, places = read_yaml_with_places(file, Room)
    assert places.where("box", "low", 1) == f"{file}:3:13"
    assert places.where_key("box", "low") == f"{file}:3:3"
    assert places.where("box", "absent") == f"{file}:3:3"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "room.yaml: the file is empty"),
        ("# only a comment\n", "room.yaml: the file is empty"),
        ("- 1\n", "room.yaml:1:1: the file must be keys with values"),
        ("name\n", "room.yaml:1:1: the file must be keys with values"),
        (GOOD + "nmae: x\n", "room.yaml:7:1: unknown key 'nmae' (hint: did you mean 'name'? known keys: name, box, "),
        (GOOD.replace("margin", "magrin"), "room.yaml:4:3: unknown key 'box.magrin' (hint: did you mean 'margin'? "),
        (GOOD.replace("name: lab\n", ""), "room.yaml:1:1: the key 'name' is missing"),
        (GOOD.replace("  low: [-1, 2.5e-1]\n", ""), "room.yaml:3:3: the key 'low' is missing in box"),
        (GOOD.replace("0.2", "-1"), "room.yaml:4:11: box.margin should be greater than or equal to 0, not -1"),
        (GOOD.replace("0.2", "yes"), 'room.yaml:4:11: box.margin should be a valid number, not "yes"'),
        (GOOD.replace("0.2", "'0.2'"), 'room.yaml:4:11: box.margin should be a valid number, not "0.2"'),
        (GOOD.replace("0.2", "true"), "room.yaml:4:11: box.margin should be a valid number, not true"),
        (GOOD.replace("0.2", ".nan"), "room.yaml:4:11: a finite number is needed, not .nan"),
        (GOOD.replace("0.2", "-.INF"), "room.yaml:4:11: a finite number is needed, not -.INF"),
        (GOOD.replace("0.2", "inf"), "room.yaml:4:11: a finite number is needed, not inf"),
        (GOOD.replace("0.2", "1e999"), "room.yaml:4:11: the number 1e999 is too large"),
        (GOOD.replace("lab", "3"), "room.yaml:1:7: name should be a valid string, not 3"),
        (GOOD.replace("tangent", "sideways"), "room.yaml:5:7: mode should be 'fixed', 'tangent' or 'free'"),
        (GOOD + "name: again\n", "room.yaml:7:1: the key 'name' occurs twice"),
        (GOOD + "? [1]\n: 2\n", "room.yaml:7:3: a key must be a word"),
        (GOOD + "count: 1.5\n", "room.yaml:7:8: count should be a valid integer"),
        (GOOD + "\tcount: 1\n", "room.yaml:7:1: a tab"),
        (GOOD + "---\n" + GOOD, "room.yaml:7:1: expected a single document"),
        ("name: &a lab\nbox: *a\n", "room.yaml:1:7: anchors and aliases are not allowed"),
        ("name: !!python/name:os.system x\n", "room.yaml:1:7: the tag tag:yaml.org,2002:python/name:os.system is not"),
        ("name: !mine x\n", "room.yaml:1:7: the tag !mine is not allowed"),
        ("<<: {name: x}\n", "room.yaml:1:1: unknown key '<<'"),
        ("name: [[" + "[" * 2000, "room.yaml:1:26: nested more than 20 deep"),
        (b"name: \xff\xfe\n", "room.yaml:1: not UTF-8 text"),
        (b"name: a\nbox: \x00\x01\n", "room.yaml:2: the character"),
        ('name: "\\ud800"\n', "room.yaml:1:7: half of a surrogate pair"),
        ("name: " + "9" * 5000, "room.yaml:1:7: the number 99999"),
    ],
)
def test_each_mistake_is_named_with_its_place(read, content, message):
    with pytest.raises(InputError) as caught:
        read(content)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_first_of_several_mistakes_is_told_and_the_others_counted(read):
    with pytest.raises(InputError, match=r":3:9: .*\(1 more\)"):
        read("name: x\nbox:\n  low: [a, b]\n")


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(InputError, match=r"gone\.yaml: no such file"):
        read_yaml(tmp_path / "gone.yaml", Room)
    with pytest.raises(InputError, match="a folder, not a file"):
        read_yaml(tmp_path, Room)
    with pytest.raises(InputError, match="cannot be read"):
        read_yaml("room\0.yaml", Room)
    with pytest.raises(InputError, match="cannot be read"):
        read_yaml(pathlib.Path("n" * 5000), Room)


def test_toml_is_refused_as_such(tmp_path):
    (tmp_path / "path.toml").write_text('name = "x"\nwaypoints = [[0, 0, 1], [1, 0, 1]]\n')
    with pytest.raises(InputError, match=r"path\.toml: a TOML file, not YAML \(hint: write `key: value`"):
        load_path_file(tmp_path / "path.toml")


def test_an_alias_bomb_is_refused_at_its_first_anchor(read):
    lines = ["a: &a [x,x,x,x,x,x,x,x,x,x]"]
    for before, name in zip("abcdefgh", "bcdefghi", strict=True):
        lines.append(f"{name}: &{name} [{','.join(['*' + before] * 10)}]")
    with pytest.raises(InputError, match=r":1:4: anchors and aliases"):
        read("\n".join(lines))


def test_a_file_that_would_take_long_to_read_is_refused_at_once(tmp_path):
    file = tmp_path / "path.yaml"
    file.write_text("waypoints: [" + "[0.123, 0.456, 0.789], " * 20_000 + "[0, 0, 1]]")
    with pytest.raises(InputError, match="larger than 200 kB") as error:
        read_yaml(file, Box)
    assert "as a CSV" in error.value.hint


@pytest.mark.parametrize(
    ("text", "place", "what"),
    [
        ("waypoints:\n  - [0, 0, 1]\n\t- [1, 0, 1]\n", ":3:1", "a tab"),
        ("waypoints:\n  - [0, 0, 1]\n - [1, 0, 1]\n", ":3:2", "not indented like"),
        ("waypoints: [[0, 0, 1]\nyaw: fixed\n", ":2:1", "not closed before here"),
        ("name: a: b\n", ":1:8", "a second colon"),
        ("waypoints: []\nyaw fixed\nlaps: 1\n", ":3:1", "a key without a colon"),
    ],
)
def test_slips_of_typing_are_told_in_plain_words(tmp_path, text, place, what):
    file = tmp_path / "path.yaml"
    file.write_text(text)
    with pytest.raises(InputError, match=what) as error:
        load_path_file(file)
    assert error.value.where == f"{file}{place}"
    assert "<" not in str(error.value)
