"""A vehicle's URI is read strictly: what cflib would take for something else is refused."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cfplan.errors import InputError
from cfplan.flight.radio.uri import check_vehicle_uri

GOOD = (
    "radio://0/80/2M/E7E7E7E7E7",
    "radio://0/80/2M",
    "radio://0/80",
    "radio://1/0/250K/e7e7e7e701",
    "radio://ABCDEF0123/125/1M/E7E7E7E7E7?rate_limit=100",
    "usb://0",
    "udp://127.0.0.1:19850",
    "udp://[::1]:19850",
    "sim://0",
    "sim://12",
)
BAD = {
    "": "not the URI of a vehicle",
    "radio//0/80": "not the URI of a vehicle",
    "serial://ttyACM0": "not the URI of a vehicle",
    "radio://": "not the URI of a radio",
    "radio://0": "'nothing' is not a channel",
    "radio://0/126/2M": "not a channel",
    "radio://0/-1/2M": "not a channel",
    "radio://0/80/3M/E7E7E7E7E7": "'3M' is not a rate",
    "radio://0/80/2M/E7E7": "not an address",
    "radio://0/80/2M/E7E7E7E7EX": "not an address",
    "radio://0/80/2M/E7E7E7E7E7/more": "not the URI of a radio",
    "udp://127.0.0.1": "host and port",
    "udp://:19850": "host and port",
    "udp://127.0.0.1:70000": "host and port",
    "usb://": "number of the USB device",
    "sim://nonsense": "no such virtual vehicle",
}


@pytest.mark.parametrize("uri", GOOD)
def test_a_good_uri_passes(uri):
    check_vehicle_uri(uri)


@pytest.mark.parametrize("uri", BAD)
def test_a_bad_uri_says_what_is_wrong_and_what_one_looks_like(uri):
    with pytest.raises(InputError, match=BAD[uri]) as caught:
        check_vehicle_uri(uri)
    assert caught.value.where == uri
    assert "://" in caught.value.hint
    assert "\n" not in str(caught.value)


@given(st.text(max_size=40) | st.text("radiousbmp:/0123456789EM.", max_size=40).map("radio://".__add__))
def test_any_text_is_a_uri_or_an_error_with_a_hint(text):
    error = error_of(text)
    assert error is None or error.hint


def error_of(uri: str) -> InputError | None:
    try:
        check_vehicle_uri(uri)
    except InputError as error:
        return error
    return None
