"""The study of latency: the first setpoint that a new plan changes, and the tables."""

from types import SimpleNamespace

import numpy as np
import pytest

from cfplan.errors import InputError
from cfplan.flight.setpoints.commitment import QUANTUM
from cfplan.flight.setpoints.packets import FullStateSetpoints, encode
from studies.latency import DELAYS, ONE_BY_ONE, PARTS, STUDY, Settings, Stretch, find_replans, first_changes


def rows(*positions):
    """Setpoints at places along x, in quanta."""
    places = np.array(positions, dtype=float)[:, None] * [QUANTUM, 0.0, 0.0]
    still = np.zeros_like(places)
    level = np.tile([0.0, 0.0, 0.0, 1.0], (len(places), 1))
    return encode(FullStateSetpoints(places, still, still, level, still))


@pytest.mark.parametrize(
    ("splice", "payloads", "numbers"),
    [
        (2, rows(2, 3, 4), None),  # the same as before
        (2, rows(2, 3, 9, 9), (4, 4)),
        (2, rows(2, 4, 9), (3, 4)),  # off by a quantum first, then by more
        (2, rows(2, 4, 4), None),
        (3, rows(3, 4, 4, 4), None),  # beyond the end the last one is repeated
        (3, rows(3, 4, 4, 7), (6, 6)),
        (9, rows(4, 6), (10, 10)),
    ],
)
def test_the_first_changes_are_of_bytes_and_of_more_than_a_quantum_of_position(splice, payloads, numbers):
    assert first_changes(rows(0, 1, 2, 3, 4), splice, payloads) == numbers


def replan(*times):
    return dict.fromkeys(PARTS, 0.0) | dict(zip((*DELAYS, *PARTS), times, strict=False))


def tables(replans):
    stretch = Stretch(ONE_BY_ONE, 60.0, 120, len(replans), 0, 0, 0, 0.0, 0.0, 0.0, 0.0, 1.0, replans)
    hovering = Stretch("hovering, no requests", 60.0, 0, 0, 0, 0, 0, 1e-4, 2e-4, 3e-4, 4e-4, 1.0)
    return {each.name: each.rows for each in STUDY.tables(Settings(), [hovering, stretch])}


def test_its_table_has_a_row_for_each_delay():
    found = tables([replan(0.05 + 0.001 * k, 0.2 + 0.001 * k, 0.04) for k in range(101)])
    first = found["latency"][0]
    assert [row["what"] for row in found["latency"]] == ["first changed setpoint", "changed motion", "answer"]
    assert (first["count"], first["median"], first["p99"]) == (101, pytest.approx(0.1), pytest.approx(0.149))
    assert [(row["what"], row["rate"]) for row in found["rate"]] == [("hovering, no requests", 0.0)]


def test_without_any_accepted_request_it_is_an_error():
    flight = SimpleNamespace(heard=[], committed=[], sent={})
    with pytest.raises(InputError, match="no request was accepted"):
        find_replans(flight, {})


def test_the_parts_of_the_time_are_measured_separately():
    replans = [replan(0.1, 0.2, 0.08, 0.001, 0.0, 0.02, 0.04, 0.01 * k, 0.02) for k in range(11)]
    rows = {row["what"]: row for row in tables(replans)["budget"]}
    assert rows["plan"]["median"] == pytest.approx(0.02)
    assert (rows["verified by the pilot"]["median"], rows["verified by the pilot"]["max"]) == pytest.approx((0.05, 0.1))
    assert sum(row["mean"] for row in rows.values()) == pytest.approx(0.131)
