"""URIs of motion capture."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cfplan.errors import InputError
from cfplan.flight.mocap.uri import SYSTEMS, MocapUri, no_such_body, parse_uri


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("vicon://192.168.1.2/cf1", MocapUri("vicon", "192.168.1.2", 801, "cf1")),
        ("vicon://tracker:8010/cf1/", MocapUri("vicon", "tracker", 8010, "cf1")),
        ("vicon-sdk://tracker/cf1", MocapUri("vicon-sdk", "tracker", 801, "cf1")),
        ("qualisys://10.0.0.7/my%20drone", MocapUri("qualisys", "10.0.0.7", 22222, "my drone")),
        ("optitrack://motive/cf1", MocapUri("optitrack", "motive", 1510, "cf1")),
        ("optitrack-sdk://motive/cf1", MocapUri("optitrack-sdk", "motive", 1510, "cf1")),
        ("nokov://seeker/cf1", MocapUri("nokov", "seeker", 0, "cf1")),
        ("vrpn://[fe80::1]:3884/cf1", MocapUri("vrpn", "fe80::1", 3884, "cf1")),
    ],
)
def test_a_uri_names_system_computer_and_body(text, expected):
    assert parse_uri(text, subject_needed=True) == expected


def test_a_uri_survives_being_written_and_read():
    for text in ("vicon://a/cf1", "vicon-sdk://a:9/cf1", "vrpn://[fe80::1]/x", "motionanalysis://a/cf1"):
        assert str(parse_uri(text, subject_needed=True)) == text
    assert parse_uri("vicon://a", subject_needed=False).subject == ""


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("vicon://192.168.1.2", "which body"),
        ("vicon:///cf1", "not named"),
        ("192.168.1.2/cf1", "not the URI"),
        ("vikon://a/cf1", "vikon"),
        ("vicon://a:99999/cf1", "not the URI"),
        ("vicon://a:0/cf1", "port 0"),
        ("nokov://a:80/cf1", "takes no port"),
        ("vicon://a/b/c", "one body"),
        ("vicon://a/cf1?rate=5", "not the URI"),
        ("vicon://me@a/cf1", "not the URI"),
    ],
)
def test_a_wrong_uri_is_an_error_with_a_hint(text, words):
    with pytest.raises(InputError, match=words) as caught:
        parse_uri(text, subject_needed=True)
    assert caught.value.where == text
    assert caught.value.hint


@given(st.text() | st.builds("{}://{}".format, st.sampled_from(list(SYSTEMS)), st.text()))
def test_any_text_is_a_uri_or_an_input_error(text):
    try:
        uri = parse_uri(text, subject_needed=False)
    except InputError:
        return
    assert uri.system in SYSTEMS
    assert 0 < uri.port < 65536 or uri.port == SYSTEMS[uri.system]
    assert uri.host


def test_an_error_lists_a_dozen_of_many_names_on_one_line_without_control_characters():
    names = ["\x1b[2Jclear", "new\nline", *(f"body{number:05}" * 30 for number in range(5000))]
    text = str(no_such_body(parse_uri("vicon://a/cf1", subject_needed=True), names))
    assert len(text) < 1000
    assert "and 4990 more" in text
    assert text.isprintable()
    assert "\\x1b[2Jclear" in text


def test_a_body_that_is_not_there_is_told_with_those_that_are():
    error = no_such_body(parse_uri("vicon://a/cf1", subject_needed=True), ["cf2", "gate"])
    assert "did you mean 'cf2'" in error.hint
    assert "cf2, gate" in error.hint
