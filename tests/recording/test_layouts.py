"""Every topic, field and frame that the layouts for Foxglove and PlotJuggler name is in a record."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

LAYOUTS = Path(__file__).parents[2] / "layouts"
FOXGLOVE = json.loads((LAYOUTS / "foxglove.json").read_text())
PLOTJUGGLER = ElementTree.parse(LAYOUTS / "plotjuggler.xml").getroot()
PANELS = FOXGLOVE["configById"]


@pytest.fixture(scope="module")
def record(flight):
    """Of each topic of a record its schema's name, and its last message: of JSON what it is, else as Protobuf."""
    found = {}
    with open(flight.folder / "flight.mcap", "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            if channel.message_encoding == "json":
                found[channel.topic] = schema.name, json.loads(message.data)
        for schema, channel, _, content in reader.iter_decoded_messages(topics=public_topics(reader)):
            found[channel.topic] = schema.name, content
    return found


def public_topics(reader) -> list[str]:
    channels = reader.get_summary().channels.values()
    return [channel.topic for channel in channels if channel.message_encoding == "protobuf"]


def plotted() -> Iterator[str]:
    """Every message path of Foxglove's panels."""
    for panel in PANELS.values():
        for path in panel.get("paths", ()):
            yield path["value"]


def value_at(record, path: str):
    """What a message path of Foxglove's leads to: /topic.field[0]."""
    topic, field, index = re.fullmatch(r"(/\w+)\.(\w+)(?:\[(\d+)\])?", path).groups()
    value = record[topic][1][field]
    return value if index is None else value[int(index)]


def curves(prefix: str, value) -> Iterator[str]:
    """The names that PlotJuggler gives to the numbers of a JSON message."""
    if isinstance(value, dict):
        for key, inner in value.items():
            yield from curves(f"{prefix}/{key}", inner)
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from curves(f"{prefix}[{index}]", inner)
    elif isinstance(value, int | float):
        yield prefix


def shown(node) -> Iterator[str]:
    """The panels in the tree of a layout."""
    if isinstance(node, str):
        yield node
    else:
        yield from shown(node["first"])
        yield from shown(node["second"])


@pytest.mark.parametrize("path", list(plotted()))
def test_foxglove_plots_what_a_record_has(record, path):
    assert isinstance(value_at(record, path), str if path == "/phase.phase" else int | float)


def test_foxglove_shows_each_panel_once_and_public_schemas_in_the_room(record):
    assert sorted(shown(FOXGLOVE["layout"])) == sorted(PANELS)
    room = PANELS["3D!room"]
    for topic in (*room["topics"], PANELS["RosOut!log"]["topicToRender"]):
        assert record[topic][0].startswith("foxglove.")
    frame = record["/public/tf"][1]
    assert room["followTf"] == frame.parent_frame_id == record["/public/pose"][1].frame_id
    assert set(room["transforms"]) == {f"frame:{frame.child_frame_id}"}


def test_plotjuggler_plots_what_a_record_has(record):
    there = {
        name for topic, (_, message) in record.items() if isinstance(message, dict) for name in curves(topic, message)
    }
    named = [curve.get("name") for curve in PLOTJUGGLER.iter("curve")]
    assert len(named) == 20
    assert set(named) <= there


def test_plotjugglers_splitters_have_what_they_count():
    for splitter in PLOTJUGGLER.iter("DockSplitter"):
        assert len(splitter) == int(splitter.get("count")) == len(splitter.get("sizes").split(";"))
