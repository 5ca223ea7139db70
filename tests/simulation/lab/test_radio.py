"""The radio: nothing is lost without cost, nothing overtakes, and what a dead one held comes out old."""

import pytest

from cfplan.errors import InputError
from cfplan.flight.radio.perishable import MAX_AGE
from cfplan.simulation.lab.radio import COMPUTER_QUEUE, Radio, RadioFault, RadioFaultKind

LOSS, DELAY, DEAD = RadioFaultKind.LOSS, RadioFaultKind.DELAY, RadioFaultKind.DEAD


def passed(radio, packets, *, seconds=2.0, every=0.01, begin=0.0):
    """(when, packet) of what reaches the vehicle; one is sent each `every` s where there is room."""
    found, waiting, step = [], list(packets), 0
    while step * 0.001 < seconds:
        now = begin + step * 0.001
        if waiting and step % round(every * 1000) == 0:
            radio.send(waiting.pop(0))
        found += [(now, packet) for packet in radio.step(now)[0]]
        step += 1
    return found


def numbered(count):
    return [number.to_bytes(2, "little") for number in range(count)]


def test_a_good_radio_passes_everything_on_within_a_transaction_or_two():
    found = passed(Radio(0.0), numbered(100))
    assert [packet for _, packet in found] == numbered(100)
    assert max(now - 0.01 * number for number, (now, _) in enumerate(found)) <= 0.002


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5])
def test_loss_costs_time_and_order_is_kept(share):
    radio = Radio(0.0)
    radio.inject(RadioFault(LOSS, size=share), 0.0)
    found = passed(radio, numbered(150))
    assert [packet for _, packet in found] == numbered(150)
    mean = sum(now - 0.01 * number for number, (now, _) in enumerate(found)) / len(found)
    assert mean == pytest.approx(0.001 * share / (1 - share), abs=0.001)


def test_a_delay_is_added_both_ways():
    radio = Radio(0.0)
    radio.inject(RadioFault(DELAY, size=0.03), 0.0)
    radio.send(b"up")
    radio.answer(b"down")
    assert radio.step(0.029) == ([], [])
    assert radio.step(0.0301) == ([b"up"], [b"down"])
    assert not radio.busy


def test_a_dead_radio_keeps_what_it_had_and_turns_the_rest_away():
    radio = Radio(0.0)
    radio.inject(RadioFault(DEAD, start=0.5, duration=0.5), 0.0)
    found = passed(radio, numbered(200))
    silent = [now for now, _ in found if 0.5 < now < 1.0]
    assert not silent
    stale = [number for number, packet in enumerate(numbered(200)) for now, got in found
             if got == packet and now - 0.01 * number > 0.1]  # fmt: skip
    assert len(stale) == COMPUTER_QUEUE
    assert radio.dropped > 40


def test_setpoints_and_poses_that_a_dead_radio_held_do_not_come_out():
    radio = Radio(0.0)
    radio.inject(RadioFault(DEAD, start=0.5, duration=0.5), 0.0)
    poses = [b"\x6d\x08" + number for number in numbered(200)]  # port 6, channel 1, a pose
    found = passed(radio, poses)
    assert max(now - 0.01 * poses.index(packet) for now, packet in found) < MAX_AGE + 0.02
    assert not any(0.52 < 0.01 * poses.index(packet) < 0.93 for _, packet in found)


def test_the_vehicles_queue_holds_a_hundred_and_twenty():
    radio = Radio(0.0)
    radio.inject(RadioFault(DEAD, duration=1.0), 0.0)
    for packet in numbered(200):
        radio.answer(packet)
    radio.step(1.0)
    _, down = radio.step(2.0)
    assert down == numbered(120)


@pytest.mark.parametrize(
    "wrong", [{"kind": LOSS, "size": 1.0}, {"kind": LOSS, "size": -0.1}, {"kind": DEAD, "duration": 0.0},
              {"kind": DELAY, "size": float("nan")}, {"kind": DELAY, "size": -1.0}]
)  # fmt: skip
def test_a_fault_that_makes_no_sense_is_refused(wrong):
    with pytest.raises(InputError):
        RadioFault(**wrong)
