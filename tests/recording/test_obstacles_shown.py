"""What draws the room draws its obstacles: figures, replays, Foxglove, the report."""

from dataclasses import replace

import numpy as np
import pytest
import rerun as rr
from mcap.reader import make_reader
from mcap.writer import Writer
from mcap_protobuf.decoder import DecoderFactory

from cfplan.errors import InputError
from cfplan.flight.telemetry import Event, Level
from cfplan.geometry.min_snap import min_snap
from cfplan.planning.figure import OBSTACLE, draw_plan
from cfplan.planning.plan import plan
from cfplan.recording.header import header_from_json, header_of_plan, header_to_json
from cfplan.recording.public_topics import SCENE, PublicTopics
from cfplan.recording.rerun.record_view import log_room
from cfplan.safety.space import Box, Cylinder, outline

TABLE = Box((0.5, 1.0, 0.0), (1.5, 2.0, 0.8), 0.5, "table")
POLE = Cylinder(-1.0, 0.5, 0.1, 0.0, 2.0, "pole")


@pytest.fixture(scope="module")
def made(limits):
    here = replace(limits, space=replace(limits.space, obstacles=(TABLE, POLE)))
    return plan(min_snap([[0.0, -1.5, 1.0], [0.1, 0.5, 1.0]]), limits.airframe, here, planner="expert")


@pytest.fixture(scope="module")
def header(made, tmp_path_factory):
    source = tmp_path_factory.mktemp("path") / "path.yaml"
    return header_of_plan(made, name="line", uri="sim://0", source=source, wall_time_at_zero=0.0)


def test_an_outline_is_the_obstacle_from_above():
    corners = outline(TABLE)
    np.testing.assert_allclose(corners.mean(axis=0, where=np.arange(5)[:, None] < 4), [1.0, 1.5], atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(np.diff(corners, axis=0), axis=1), 1.0)
    assert np.degrees(np.arctan2(*(corners[0] - corners[1])[::-1])) % 90 == pytest.approx(np.degrees(0.5))
    np.testing.assert_allclose(np.hypot(*(outline(POLE) - [-1.0, 0.5]).T), 0.1)


def test_a_record_keeps_the_obstacles_and_an_older_one_has_none(header):
    text = header_to_json(header)
    assert header_from_json(text).obstacles == (TABLE, POLE)
    older = header_to_json(replace(header, obstacles=()))
    assert header_from_json(older.replace(', "obstacles": []', "")).obstacles == ()
    with pytest.raises(InputError, match="header cannot be read"):
        header_from_json(text.replace('"yaw": 0.5', '"yaw": "east"'))


def test_the_figure_has_each_obstacle_in_both_views(made):
    above, aside = draw_plan(made, "line").subfigs[0].axes
    for axes in (above, aside):
        shapes = [each for each in axes.patches if each.get_facecolor()[:3] == pytest.approx(rgb(OBSTACLE), abs=1e-3)]
        assert len(shapes) == 2
    assert {"table", "pole"} <= {text.get_text() for text in above.texts}


def rgb(colour):
    return tuple(int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5))


def test_foxglove_has_solids(header, tmp_path):
    with (tmp_path / "scene.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        PublicTopics(writer, header, lambda time: round(1e9 * time)).add(Event(1.0, Level.INFO, "begun"))
        writer.finish()
    with (tmp_path / "scene.mcap").open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        scenes = [each.decoded_message for each in reader.iter_decoded_messages(topics=[SCENE])]
    room = scenes[0].entities[0]
    (box,), (cylinder,) = room.cubes, room.cylinders
    assert (box.size.x, box.size.y, box.size.z) == pytest.approx((1.0, 1.0, 0.8))
    assert (cylinder.size.x, cylinder.size.z, cylinder.pose.position.z) == pytest.approx((0.2, 2.0, 1.0))


def test_the_replay_has_boxes_and_cylinders(header, tmp_path):
    file = tmp_path / "room.rrd"
    stream = rr.RecordingStream("obstacles")
    stream.save(file)
    log_room(stream, header)
    stream.flush()
    stream.disconnect()
    content = file.read_bytes()
    assert b"obstacles/boxes" in content
    assert b"obstacles/cylinders" in content
