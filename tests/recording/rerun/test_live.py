"""The live view: the flight as the messages come, never in the way of whoever brings them."""

import numpy as np
import pytest
import rerun as rr
from rerun.chunk import RrdReader

from cfplan.errors import InputError
from cfplan.flight.clock import SteppedClock
from cfplan.flight.setpoints.encoding import LEAD
from cfplan.flight.telemetry import PhaseEntered, PoseReceived, SetpointSent
from cfplan.recording.rerun import layout, live
from cfplan.recording.rerun.live import LiveView, live_blueprint, open_live
from cfplan.recording.topics import TOPICS, columns_from_json, columns_of, message_to_json


def rows(file, entity, component):
    """{time in s: values} of one component of an entity."""
    found = {}
    for chunk in RrdReader(file).stream().filter(content=[f"/{entity}"]):
        batch = chunk.to_record_batch()
        if layout.TIMELINE in batch.schema.names and component in batch.schema.names:
            times = [stamp.value * 1e-9 for stamp in batch.column(layout.TIMELINE)]
            found |= dict(zip(times, batch.column(component).to_pylist(), strict=True))
    return found


@pytest.fixture(scope="module")
def watched(flight, tmp_path_factory):
    """The made-up flight, shown in batches of five hundred messages."""
    file = tmp_path_factory.mktemp("live") / "live.rrd"
    stream = rr.RecordingStream("cfplan")
    stream.save(file, default_blueprint=live_blueprint(flight.header))
    clock = SteppedClock()
    with LiveView(stream, flight.header, clock=clock) as view:
        for index, message in enumerate(flight.messages):
            view.show(message)
            if index % 500 == 499:
                clock.sleep(live.PERIOD)
    assert view.failure == ""
    return file


def test_everything_that_was_told_is_shown(flight, watched):
    start = min(message.time for message in flight.messages)
    for kind, entity, when in (
        (PoseReceived, layout.BODY, lambda pose: pose.time),
        (SetpointSent, layout.GHOST, lambda sent: sent.due + round(sent.time - sent.due, 2) + LEAD),  # where planned
    ):
        told = [message for message in flight.messages if isinstance(message, kind)]
        wanted = {round(when(message) - start, 6): message.position for message in told}
        shown = rows(watched, entity, "Transform3D:translation")
        times = sorted(shown)
        np.testing.assert_allclose(times, sorted(wanted), atol=1e-6)
        np.testing.assert_allclose(
            [shown[time][0] for time in times], [wanted[time] for time in sorted(wanted)], atol=1e-6
        )
    phases = [message.phase for message in flight.messages if isinstance(message, PhaseEntered)]
    shown = rows(watched, layout.PHASES, "StateChange:state")
    assert [shown[time][0] for time in sorted(shown)] == [str(phase) for phase in phases]


def test_the_flown_track_has_no_gap_between_batches(flight, watched):
    steps = rows(watched, layout.FLOWN, "LineStrips3D:strips")
    poses = sum(isinstance(message, PoseReceived) for message in flight.messages)
    assert len(steps) == poses - 1


def test_limits_are_drawn_from_the_first_message_on(watched):
    assert min(rows(watched, f"{layout.PLOTS}/speed/limit", "Scalars:scalars")) == 0.0


def test_messages_become_the_columns_that_a_record_reads_back(flight):
    for topic in TOPICS:
        messages = [message for message in flight.messages if type(message) is topic.message]
        direct = columns_of(topic, messages)
        read = columns_from_json(topic, [message_to_json(message) for message in messages])
        for name in type(direct).__slots__:
            np.testing.assert_array_equal(getattr(direct, name), getattr(read, name))


def test_a_view_that_breaks_is_not_heard_of_in_the_flight(flight, monkeypatch):
    def broken(*_):
        raise RuntimeError("the viewer was closed")

    monkeypatch.setattr(live, "log_columns", broken)
    clock = SteppedClock()
    with LiveView(rr.RecordingStream("cfplan"), flight.header, clock=clock) as view:
        for message in flight.messages[:2000]:
            view.show(message)
            clock.sleep(0.01)
    assert "the viewer was closed" in view.failure


def test_a_view_that_cannot_keep_up_leaves_the_oldest_out(flight, tmp_path):
    stream = rr.RecordingStream("cfplan")
    stream.save(tmp_path / "live.rrd")
    view = LiveView(stream, flight.header, clock=SteppedClock())
    first = next(message for message in flight.messages if isinstance(message, PhaseEntered))
    pose = next(message for message in flight.messages if isinstance(message, PoseReceived))
    view.show(first)
    for _ in range(live.CAPACITY):
        view.show(pose)
    with view:
        pass
    assert rows(tmp_path / "live.rrd", layout.BODY, "Transform3D:translation")
    assert not rows(tmp_path / "live.rrd", layout.PHASES, "StateChange:state")


def test_a_view_of_a_flight_that_says_nothing_is_no_failure(flight):
    clock = SteppedClock()
    with LiveView(rr.RecordingStream("cfplan"), flight.header, clock=clock) as view:
        clock.sleep(1.0)
    assert view.failure == ""


def test_without_a_screen_there_is_no_live_view(flight, monkeypatch):
    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with pytest.raises(InputError, match="no screen") as caught:
        open_live(flight.header, flight.folder)
    assert "--live" in caught.value.hint
