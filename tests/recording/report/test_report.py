"""The report: the numbers of the record, on a page that needs nothing else and runs nothing."""

import dataclasses
import html
import json
import math
import re
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from cfplan.cli import cfplan
from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.planning.plan import plan
from cfplan.planning.plan_file import save_plan
from cfplan.recording.record import Events
from cfplan.recording.report.charts import Curve, place_chart, time_chart
from cfplan.recording.report.page import page, write_page
from cfplan.recording.report.report import flight_to_dict, read_flight, rows
from cfplan.recording.summary import reference_span, summarise
from cfplan.recording.writer import RecordWriter, write_summary
from cfplan.safety.limits_file import load_limits

CHROMIUM = shutil.which("chromium")


@pytest.fixture(scope="module")
def folder(flight, tmp_path_factory):
    """The made-up flight's folder, to which tests may add."""
    place = tmp_path_factory.mktemp("reported") / "20240101-120000-figure8"
    shutil.copytree(flight.folder, place)
    return place


class Page(HTMLParser):
    """Collects tags with their attributes, and the text of the tables, row by row."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.table, self.open = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.append((tag, dict(attributes)))
        if tag not in ("meta",):
            self.open.append(tag)
        if tag == "tr":
            self.table.append([])
        if tag in ("td", "th"):
            self.table[-1].append("")

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ("td", "th"):
            self.table[-1][-1] += data

    def cell(self, label):
        return next(row for row in self.table if row[0] == label)[1:]


def run(*arguments):
    return CliRunner().invoke(cfplan, [str(argument) for argument in arguments])


def test_the_table_says_what_the_summary_says(folder):
    flight = read_flight(folder)
    summary, shown = summarise(flight.record), Page(page([flight]))
    assert shown.cell("deviation in time, max") == [f"{100 * summary.max_deviation:.1f} cm"]
    assert shown.cell("travel time, planned") == ["10.00 s"]
    assert shown.cell("peak speed") == [
        f"{summary.peak_speed:.2f} m/s ({100 * summary.peak_speed / 2.0:.0f} % of the plan's limit)"
    ]
    assert shown.cell("pose dropouts") == ["1"]
    assert shown.open == []  # every tag is closed


def test_the_peak_acceleration_is_that_of_the_estimates_along_the_path(folder):
    record = read_flight(folder).record
    begin, end = reference_span(record)
    along = [
        np.linalg.norm(a)
        for t, a in zip(record.estimates.time, record.estimates.acceleration, strict=True)
        if begin <= t <= end
    ]
    assert summarise(record).peak_acceleration == pytest.approx(max(along))


def test_the_page_needs_nothing_else_and_runs_nothing(folder):
    shown = Page(page([read_flight(folder)] * 2))
    assert {tag for tag, _ in shown.tags} & {"script", "link", "img", "iframe", "object"} == set()
    values = [value for _, attributes in shown.tags for value in attributes.items()]
    addresses = [value for name, value in values if name in ("src", "href", "xlink:href")]
    addresses += [place for _, value in values for place in re.findall(r"url\(([^)]*)", value or "")]
    assert all(address.startswith("#") for address in addresses)
    assert not [name for name, _ in values if name.startswith("on")]
    policy = next(values["content"] for tag, values in shown.tags if values.get("http-equiv"))
    assert policy.startswith("default-src 'none'")


def test_several_flights_stand_in_one_table_under_their_names(flight, tmp_path):
    folders = [shutil.copytree(flight.folder, tmp_path / name) for name in ("toppquad", "learned")]
    shown = Page(page([read_flight(place) for place in folders]))
    assert shown.table[0] == ["", "toppquad", "learned"]
    assert len(shown.cell("battery")) == 2


def test_events_and_phases_stand_in_the_order_of_their_time(folder):
    flight = read_flight(folder)
    table = Page(page([flight])).table
    first = next(index for index, row in enumerate(table) if row[1:] == ["phase", "connect"])
    told = table[first : first + len(flight.record.events.time) + len(flight.record.phases.time)]
    times = [float(row[0].removesuffix(" s")) for row in told]
    assert times == sorted(times)
    assert ["warning", "no pose for 0.1 s"] in [row[1:] for row in told]


@pytest.mark.parametrize("text", ["<script>alert(1)</script>", "a & b", "\"quoted\" 'twice'", "ψ̇ ≤ 8 rad/s"])
def test_texts_are_shown_as_they_are_never_run(folder, text):
    flight = read_flight(folder)
    events = Events(np.array([5001.0]), np.array(["info"]), np.array([text]))
    flight = dataclasses.replace(flight, name=text, record=dataclasses.replace(flight.record, events=events))
    shown = Page(page([flight, flight]))
    assert "script" not in {tag for tag, _ in shown.tags}
    assert text in [cell for row in shown.table for cell in row]
    assert shown.table[0][1:] == [text, text]


def test_a_record_without_a_plan_says_so(folder):
    flight = read_flight(folder)
    assert flight.certificate is None
    assert "No plan lies beside it" in page([flight])


def test_the_certificate_is_that_of_the_plan_beside_the_record(flight, tmp_path, made_plan):
    place = shutil.copytree(flight.folder, tmp_path / "flown")
    save_plan(made_plan, place / "plan.parquet")
    reported = read_flight(place)
    shown = Page(page([reported]))
    assert reported.certificate == made_plan.certificate
    for row in made_plan.certificate.rows():
        assert list(row) in shown.table
    assert shown.cell("planner") == [made_plan.planner]


def test_a_plan_that_cannot_be_read_is_said_and_the_rest_is_shown(flight, tmp_path):
    place = shutil.copytree(flight.folder, tmp_path / "flown")
    (place / "plan.parquet").write_bytes(b"PAR1 and nothing else")
    reported = read_flight(place)
    assert "cannot be read" in reported.notes[0]
    assert "Deviation, m" in page([reported])


def test_a_truncated_record_is_reported_as_such(flight, tmp_path):
    place = shutil.copytree(flight.folder, tmp_path / "flown")
    file = place / "flight.mcap"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    assert "ends early" in page([read_flight(place)])


def test_an_empty_record_is_a_page_of_unknowns(tmp_path, small_header):
    RecordWriter(tmp_path / "empty", small_header).close()
    reported = read_flight(tmp_path / "empty")
    shown = Page(page([reported, reported]))
    assert shown.cell("travel time, flown") == ["–", "–"]
    json.dumps(flight_to_dict(reported), allow_nan=False)


def test_how_the_flight_ended_is_told(flight, tmp_path):
    place = shutil.copytree(flight.folder, tmp_path / "flown")
    write_summary(place, {"outcome": {"reason": "the pose is too old", "exit_code": 7}})
    assert dict(rows(read_flight(place)))["ended"] == "the pose is too old"


def test_the_command_writes_the_page_beside_the_record_once(flight, tmp_path):
    place = shutil.copytree(flight.folder, tmp_path / "flown")
    assert run("report", place).exit_code == 0
    written = (place / "report.html").read_text()
    again = run("report", place)
    assert isinstance(again.exception, InputError)
    assert "--force" in again.exception.hint
    (place / "report.html").write_text("mine")
    assert run("report", place, "--force").exit_code == 0
    assert (place / "report.html").read_text() == written
    assert sorted(file.suffix for file in place.iterdir() if file.name.startswith(".")) == []


def test_json_is_the_numbers_and_no_page(flight, tmp_path):
    place = shutil.copytree(flight.folder, tmp_path / "flown")
    result = run("report", place, place, "--json")
    assert result.exit_code == 0, result.output
    first, second = json.loads(result.stdout)["flights"]
    assert first == second
    assert first["max_deviation"] == pytest.approx(summarise(flight.record).max_deviation)
    assert first["shares"]["peak_speed"] == pytest.approx(first["peak_speed"] / 2.0)
    assert not (place / "report.html").exists()


def test_a_place_that_is_no_record_is_an_error_and_nothing_is_written(tmp_path, folder):
    result = run("report", folder, tmp_path / "nowhere", "-o", tmp_path / "page.html")
    assert isinstance(result.exception, InputError)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_cannot_be_written_is_an_error(folder, tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        write_page([read_flight(folder)], tmp_path / "nowhere" / "page.html")


@pytest.fixture(scope="module")
def made_plan():
    limits = load_limits(Path(__file__).parents[3] / "safety.yaml")
    path = min_snap([[-1, -1, 0.8], [0, 0.5, 1.2], [1, -0.5, 0.9]])
    return plan(path, limits.airframe, limits, planner="minsnap", nodes=60)


# charts


def points(chart, colour="#000000"):
    """(x, y) in the chart of each line that is drawn in a colour, and whether a new stroke begins there."""
    paths = re.findall(rf'<path d="([^"]*)"[^>]*stroke: {colour}', chart)
    return [
        np.array([(float(x), float(y), move == "M") for move, x, y in re.findall(r"([ML]) ([-\d.]+) ([-\d.]+)", path)])
        for path in paths
    ]


def time_labels(chart):
    """Where on the time axis which number stands."""
    return re.findall(r'text-anchor: middle[^"]*" x="([\d.]+)"[^>]*>([^<]*)', chart)


def test_no_spike_is_lost_however_many_points_there_are():
    x, y = np.linspace(0, 100, 200_000), np.random.default_rng(0).normal(0, 0.1, 200_000)
    y[[20_001, 123_457]] = 5.0, -3.0
    (drawn,) = points(time_chart("spikes", [Curve("a", x, y, (0, 0, 0))]))
    assert len(drawn) < 10_000
    level = np.median(drawn[:, 1])
    assert drawn[:, 1].max() > level + 30
    assert drawn[:, 1].min() < level - 30


@pytest.mark.parametrize("size", [50, 50_000])
def test_a_gap_breaks_the_line(size):
    x = np.linspace(0, 50, size)
    y = np.where((x > 20) & (x < 30), np.nan, x)
    chart = time_chart("gap", [Curve("a", x, y, (0, 0, 0))])
    assert sum(points(chart)[0][:, 2]) == 2
    assert "nan" not in chart


def test_places_are_drawn_to_one_scale_in_both_axes():
    angle = np.linspace(0, 2 * np.pi, 100)
    (circle,) = points(place_chart("circle", [Curve("a", 3 * np.cos(angle), 3 * np.sin(angle), (0, 0, 0))], ("x", "y")))
    assert np.ptp(circle[:, 0]) == pytest.approx(np.ptp(circle[:, 1]), abs=0.3)


@pytest.mark.parametrize("name", [f"flight of a long name {'long ' * 40}", "_hidden", "$x", "飛行", "a & <b>"])
def test_every_name_stands_whole_in_the_legend(name):
    chart = place_chart("many", [Curve(name, np.arange(2.0), np.arange(2.0), (0, 0, 0))], ("x", "y"))
    assert html.escape(name) in chart


def test_charts_over_the_same_span_are_of_one_time_axis():
    axes = [
        time_labels(time_chart("t", [curve], span=(0.0, 9.0)))
        for curve in (
            Curve("a", np.array([4.0, 5.0]), np.ones(2), (0, 0, 0)),
            Curve("b", np.arange(9.0), 1e-4 * np.arange(9.0), (0, 0, 0)),
        )
    ]
    assert axes[0] == axes[1]
    assert len(axes[0]) > 3


def test_a_limit_far_above_is_named_and_does_not_flatten_the_curve():
    curve = Curve("a", np.arange(10.0), np.arange(10.0), (0, 0, 0))
    near = time_chart("near", [curve], limits=[12.0])
    far = time_chart("far", [curve], limits=[1000.0])
    assert "limit 1000" in far
    assert np.ptp(points(far)[0][:, 1]) > 100
    assert "limit 1" not in near


@pytest.mark.parametrize("values", [[], [math.nan] * 3, [2.0], [0.0, 0.0], [1e-12, -1e-12], [1e9, 1e9 + 1]])
def test_charts_of_hardly_anything_are_charts(values):
    values = np.array(values)
    curve = Curve("a", np.arange(len(values)) * 1.0, values, (0, 0, 0))
    for chart in (time_chart("t", [curve], limits=[1.0], band=(0.0, 1.0)), place_chart("p", [curve], ("x", "y"))):
        assert "<svg" in chart
        assert "nan" not in chart


@pytest.mark.integration
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium (Debian: chromium)")
def test_a_browser_shows_the_figures_and_reports_no_error(folder, tmp_path):
    file, picture = tmp_path / "page.html", tmp_path / "page.png"
    write_page([read_flight(folder)] * 2, file)
    command = [
        CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--v=0",
        f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1200,3000", f"--screenshot={picture}", file.as_uri(),
    ]  # fmt: skip
    result = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert picture.exists(), result.stderr
    assert "CONSOLE" not in result.stderr
    from PIL import Image

    image = np.asarray(Image.open(picture).convert("RGB")).astype(int)
    blue = (np.abs(image - np.array([86, 180, 233]) * (0.55 / 0.66)) < 40).all(axis=2)
    assert blue.sum() > 1000  # the flown curves
