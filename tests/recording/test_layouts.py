"""The layouts for Foxglove and PlotJuggler have the form that both read, and all that they name is in a record.

What Foxglove reads is that of its panels' configurations in the public sources of Studio, as Lichtblick keeps them
(LayoutData, RendererConfig, PlotConfig, StateTransitionConfig, and grammar.ne of message paths); what PlotJuggler reads
is in its xmlLoadState functions and loadLayoutFromFile.
"""

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
NUMBER, TEXT, SWITCH = (int, float), (str,), (bool,)
PATH = {
    "value": TEXT,
    "enabled": SWITCH,
    "timestampMethod": ("receiveTime", "headerStamp"),
    "label": TEXT,
    "color": TEXT,
}
FORMS = {  # of each type of panel: its keys, with types or choices; a dict for what is inside, a list for each of many
    "3D": {
        "cameraState": {
            "perspective": SWITCH, "distance": NUMBER, "phi": NUMBER, "thetaOffset": NUMBER, "target": [NUMBER],
            "targetOffset": [NUMBER], "targetOrientation": [NUMBER], "fovy": NUMBER, "near": NUMBER, "far": NUMBER,
        },
        "followMode": ("follow-pose", "follow-position", "follow-none"), "followTf": TEXT, "scene": {},
        "transforms": (dict,), "topics": (dict,), "layers": (dict,), "publish": {}, "imageMode": {},
    },
    "StateTransitions": {"paths": [PATH], "isSynced": SWITCH},
    "RosOut": {"topicToRender": TEXT, "searchTerms": [TEXT], "minLogLevel": NUMBER},
    "Plot": {
        "foxglovePanelTitle": TEXT, "paths": [PATH], "showLegend": SWITCH, "isSynced": SWITCH,
        "legendDisplay": ("floating", "top", "left", "none"), "showXAxisLabels": SWITCH, "showYAxisLabels": SWITCH,
        "xAxisVal": ("timestamp", "index", "custom", "currentCustom"),
    },
}  # fmt: skip
POSE = {"visible": SWITCH, "type": ("axis", "arrow"), "axisScale": NUMBER}
GRID = {
    "visible": SWITCH, "frameLocked": SWITCH, "label": TEXT, "instanceId": TEXT, "layerId": ("foxglove.Grid",),
    "size": NUMBER, "divisions": NUMBER, "lineWidth": NUMBER, "color": TEXT, "position": [NUMBER], "rotation": [NUMBER],
    "order": NUMBER,
}  # fmt: skip
MESSAGE_PATH = re.compile(r"(?:/[\w-]+)+(?:\.[\w-]+(?:\[-?\d+\])?)*")


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


def require_form(value, form) -> None:
    """Check that a value is of a form, and has no key beside it, which would be read by none."""
    if isinstance(form, dict):
        assert set(value) <= set(form)
        for key, inner in value.items():
            require_form(inner, form[key])
    elif isinstance(form, list):
        assert isinstance(value, list)
        for inner in value:
            require_form(inner, form[0])
    else:
        assert value in form or isinstance(value, tuple(kind for kind in form if isinstance(kind, type)))


def shown(node) -> Iterator[str]:
    """The panels in the tree of a layout."""
    if isinstance(node, str):
        yield node
    else:
        assert set(node) <= {"direction", "first", "second", "splitPercentage"}
        assert node["direction"] in ("row", "column")
        assert 0 < node["splitPercentage"] < 100
        yield from shown(node["first"])
        yield from shown(node["second"])


@pytest.mark.parametrize("panel", PANELS)
def test_foxglove_reads_every_key_of_a_panel(panel):
    kind, _, name = panel.partition("!")
    assert name
    require_form(PANELS[panel], FORMS[kind])


def test_foxglove_reads_the_whole_layout():
    assert set(FOXGLOVE) == {"configById", "layout", "globalVariables", "userNodes", "playbackConfig"}
    require_form(FOXGLOVE["playbackConfig"], {"speed": NUMBER})
    room = PANELS["3D!room"]
    for settings in [*room["topics"].values(), *room["transforms"].values()]:
        require_form(settings, POSE)
    for name, grid in room["layers"].items():
        require_form(grid, GRID)
        assert grid["instanceId"] == name
    assert all(MESSAGE_PATH.fullmatch(path) for path in plotted())


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
        assert splitter.get("orientation") in ("|", "-")
        sizes = [float(size) for size in splitter.get("sizes").split(";")]
        assert len(splitter) == int(splitter.get("count")) == len(sizes)
        assert sum(sizes) == pytest.approx(1.0, abs=1e-4)


def test_plotjuggler_finds_its_window_tabs_and_plots():
    """It takes the window by name, and crashes where it has none of that name."""
    assert PLOTJUGGLER.tag == "root"
    (window,) = PLOTJUGGLER.findall("tabbed_widget")
    assert window.attrib == {"parent": "main_window", "name": "Main Window"}
    tabs = window.findall("Tab")
    assert len(tabs) + 1 == len(window)
    assert 0 <= int(window.find("currentTabIndex").get("index")) < len(tabs)
    for tab in tabs:
        assert tab.get("tab_name")
        (container,) = tab
        assert container.tag == "Container"
        assert [splitter.tag for splitter in container] == ["DockSplitter"]
        assert int(tab.get("containers")) == 1
    for area in PLOTJUGGLER.iter("DockArea"):
        (plot,) = area
        assert (plot.get("mode"), plot.get("style")) == ("TimeSeries", "Lines")
        assert {each.tag for each in plot} == {"limitY", "curve"}
    assert all(re.fullmatch("#[0-9a-f]{6}", curve.get("color")) for curve in PLOTJUGGLER.iter("curve"))
