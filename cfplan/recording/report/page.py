"""Write the report as one self-contained HTML page: tables, charts, events, certificate, provenance."""

import html
from collections.abc import Callable, Iterable, Sequence
from itertools import repeat
from pathlib import Path

import numpy as np

from cfplan.files.atomic import check_new_file, write_atomically
from cfplan.flight.telemetry import Level
from cfplan.recording.fleet_record import FleetRecord
from cfplan.recording.overlay import Trial, short_name, trial_of_record
from cfplan.recording.plots import FLOWN, Colour, finite_limits, plots
from cfplan.recording.record import Record
from cfplan.recording.report.charts import Curve, place_chart, time_chart
from cfplan.recording.report.report import ReportedFlight, head, rows
from cfplan.recording.rerun.overlay_view import COLOURS, references
from cfplan.recording.summary import reference_span

_PATH: Colour = (120, 120, 120)
_SIDES = (("From the side", 1, 2), ("From the front", 0, 2))
_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 1180px; margin: 2em auto; padding: 0 1em; }
h1 { font-size: 1.6em; } h2 { font-size: 1.25em; margin-top: 2.2em; border-bottom: 1px solid #ddd; }
h3 { font-size: 1.05em; } table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .25em .9em .25em 0; text-align: left; border-bottom: 1px solid #eee; vertical-align: top; }
.numbers td + td, .numbers th + th, .events td:first-child { text-align: right; }
.note { background: #fff6e0; padding: .4em .8em; border-left: 4px solid #e69f00; }
.fail, .error { color: #b02020; font-weight: 600; } .warning { color: #9a6700; }
.charts { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(440px, 100%), 1fr)); gap: 1em 1.5em; }
.heads { display: flex; flex-wrap: wrap; gap: 0 5em; align-items: start; } summary { cursor: pointer; color: #555; }
.charts svg { width: 100%; height: auto; } figure { margin: 0; } figcaption { padding-left: 8%; color: #444; }
figcaption b { display: block; } figcaption span { font-size: .75em; margin-right: 1.3em; overflow-wrap: anywhere; }
figcaption i { display: inline-block; width: 14px; margin-right: .4em; vertical-align: middle; }
.scroll { overflow-x: auto; } footer { color: #777; margin-top: 3em; }
@media print { body { max-width: none; margin: 0; } figure, table { break-inside: avoid; } }
"""


def page(flights: Sequence[ReportedFlight], fleet: FleetRecord | None = None) -> str:
    """Return the HTML of the page; several flights are compared first, or shown together if they are of a fleet."""
    title = flights[0].record.header.name if len(flights) == 1 else f"{len(flights)} flights"
    title = title if fleet is None else fleet.name
    parts = [f"<h1>{html.escape(title)}</h1>", _summary(flights)]
    if fleet is not None:
        parts.append(_together(fleet))
    elif len(flights) > 1:
        parts.append(_comparison([trial_of_record(flight.record, flight.name) for flight in flights]))
    parts += [_flight(flight) for flight in flights]
    versions = sorted({flight.record.header.version for flight in flights})
    return html_page(f"{title}: flight report", "".join(parts), ", ".join(versions))


def html_page(title: str, body: str, version: str) -> str:
    """Return a self-contained HTML document with the report's style."""
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'\">"
        '<meta name="viewport" content="width=device-width">'
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style></head><body>"
        f"{body}<footer>cfplan {html.escape(version)}</footer></body></html>\n"
    )


def write_page(
    flights: Sequence[ReportedFlight], file: Path, *, fleet: FleetRecord | None = None, overwrite: bool = False
) -> None:
    """Write the page atomically. Raises InputError if the file cannot be written."""
    check_new_file(file, overwrite=overwrite)
    write_atomically(file, page(flights, fleet).encode())


def _summary(flights: Sequence[ReportedFlight]) -> str:
    """Return the tables of head and numbers, one column per flight; side by side for one flight."""
    if len(flights) == 1:
        return f'<div class="heads">{_columns(flights, head)}{_columns(flights, rows)}</div>'
    return _columns(flights, lambda flight: [*head(flight), *rows(flight)])


def _columns(flights: Sequence[ReportedFlight], rows_of: Callable[[ReportedFlight], list[tuple[str, str]]]) -> str:
    heads = ["", *(flight.name for flight in flights)] if len(flights) > 1 else []
    rows = [(cells[0][0], *(value for _, value in cells)) for cells in zip(*map(rows_of, flights), strict=True)]
    return html_table("numbers", rows, heads=heads)


def html_table(
    kind: str, rows: Iterable[Sequence[str]], *, heads: Sequence[str] = (), marks: Iterable[str] = repeat("")
) -> str:
    """Return an HTML table of class `kind`; `marks` are the classes of its rows."""

    def line(cells: Sequence[str], tag: str, mark: str = "") -> str:
        body = "".join(f"<{tag}>{html.escape(cell)}</{tag}>" for cell in cells)
        return f'<tr class="{html.escape(mark)}">{body}</tr>'

    lines = [line(heads, "th")] if heads else []
    lines += [line(row, "td", mark) for row, mark in zip(rows, marks, strict=False)]
    return f'<div class="scroll"><table class="{kind}">{"".join(lines)}</table></div>'


def _together(fleet: FleetRecord) -> str:
    """Return how near the vehicles of a fleet came, as a table and over time, and where they flew."""
    pairs, notes = fleet.pairs(), "".join(f'<p class="note">{html.escape(note)}</p>' for note in fleet.notes)
    heads = ("pair", "nearest", "planned, at least", "at", "where, m")
    curves = [
        Curve(" – ".join(pair.pair), pair.time, pair.distance, COLOURS[index % len(COLOURS)])
        for index, pair in enumerate(pairs)
    ]
    charts = [*_views(fleet.trials), time_chart("Distance of columns, m", curves, limits=[fleet.apart])]
    deviations = [
        Curve(trial.name, trial.time, trial.deviation, COLOURS[index % len(COLOURS)])
        for index, trial in enumerate(fleet.trials)
    ]
    charts.append(time_chart("Deviation in time, m", deviations))
    return (
        f"<h2>Together</h2>{notes}{html_table('numbers', fleet.pair_rows(), heads=heads)}"
        "<p>Distances are horizontal, by the poses; time counts from the start of the first vehicle's path.</p>"
        f'<div class="charts">{"".join(charts)}</div>'
    )


def _comparison(trials: Sequence[Trial]) -> str:
    over = [_along(trial) for trial in trials]
    charts = _views(trials)
    for title, values in (
        ("Deviation in time, m", [trial.deviation for trial in trials]),
        ("Speed, m/s", [trial.speed for trial in trials]),
    ):
        curves = [
            Curve(short_name(trial.name), trial.time[along_rows], value[along_rows], COLOURS[index % len(COLOURS)])
            for index, (trial, value, along_rows) in enumerate(zip(trials, values, over, strict=True))
        ]
        charts.append(time_chart(f"{title}, from the start of the path", curves))
    return f'<h2>Side by side</h2><div class="charts">{"".join(charts)}</div>'


def _along(trial: Trial) -> np.ndarray:
    """Return the rows of the time along the path; all rows if it was not flown."""
    if trial.reference is None or len(trial.reference.time) == 0:
        return np.arange(len(trial.time))
    return np.flatnonzero((trial.time >= 0) & (trial.time <= trial.reference.time[-1]))


def _views(trials: Sequence[Trial]) -> list[str]:
    """Draw the flights from above, and beside that from two sides."""
    sides = "".join(_places(trials, name, across, up) for name, across, up in _SIDES)
    return [_places(trials, "From above", 0, 1), f"<div>{sides}</div>"]


def _places(trials: Sequence[Trial], title: str, across: int, up: int) -> str:
    curves = []
    for index, trial in enumerate(trials):
        colour = COLOURS[index % len(COLOURS)] if len(trials) > 1 else FLOWN
        along_rows = _along(trial)
        label = short_name(trial.name) if len(trials) > 1 else "flown"
        curves.append(Curve(label, trial.position[along_rows, across], trial.position[along_rows, up], colour))
    curves += [  # last, so that the flown lines do not cover its dashes
        Curve(f"{reference.name} (reference)", reference.position[:, across], reference.position[:, up], _PATH, True)
        for reference in references(trials)
    ]
    return place_chart(title, curves, ("xyz"[across], "xyz"[up]))


def _flight(flight: ReportedFlight) -> str:
    record = flight.record
    begin, end = (moment - record.start for moment in reference_span(record))
    band = (begin, end) if np.isfinite(begin) else None
    trial = trial_of_record(record, flight.name)
    charts, drawn = _views([trial]), plots(record)
    moments = [line.time[np.isfinite(line.time)] - record.start for plot in drawn for line in plot.lines]
    seen = np.concatenate([each for each in moments if len(each)] or [np.array([0.0, 1.0])])
    span = (float(seen.min()), float(max(seen.max(), seen.min() + 1.0)))
    for plot in drawn:
        curves = [
            Curve(
                label,
                line.time - record.start,
                line.values.reshape(len(line.time), len(line.labels))[:, column],
                colour,
            )
            for line in plot.lines
            for column, (label, colour) in enumerate(zip(line.labels, line.colours, strict=True))
        ]
        charts.append(time_chart(plot.title, curves, limits=finite_limits(plot), band=band, span=span))
    notes = "".join(f'<p class="note">{html.escape(note)}</p>' for note in flight.notes)
    return (
        f"<h2>{html.escape(flight.name)}</h2>{notes}"
        f'<div class="charts">{"".join(charts)}</div>'
        f"{_events(flight)}{_certificate(flight)}{_provenance(flight)}"
    )


def _events(flight: ReportedFlight) -> str:
    record = flight.record
    entries = [
        (time, str(level), str(text))
        for time, level, text in zip(record.events.time, record.events.level, record.events.text, strict=True)
    ]
    entries += [
        (time, "phase", str(phase)) for time, phase in zip(record.phases.time, record.phases.phase, strict=True)
    ]
    if not entries:
        return "<h3>Events</h3><p>None were recorded.</p>"
    entries.sort(key=lambda entry: entry[0])
    grave = [entry for entry in entries if entry[1] in (Level.WARNING, Level.ERROR)]
    shown = _event_table(record, grave) if grave else "<p>No warnings and no errors.</p>"
    return (
        f"<h3>Events</h3>{shown}<details><summary>All {len(entries)} events and phases</summary>"
        f"{_event_table(record, entries)}</details>"
    )


def _event_table(record: Record, entries: Sequence[tuple[float, str, str]]) -> str:
    rows = [(f"{time - record.start:.2f} s", level, text) for time, level, text in entries]
    return html_table("events", rows, marks=[level for _, level, _ in entries])


def _certificate(flight: ReportedFlight) -> str:
    certificate = flight.certificate
    if certificate is None:
        return ""
    heads = ("limit", "worst", "allowed", "share", "at", "where, m")
    marks = ["" if margin.passed else "fail" for margin in certificate.margins]
    table = html_table("numbers", certificate.rows(), heads=heads, marks=marks)
    verdict = "passed" if certificate.passed else '<span class="fail">failed</span>'
    return f"<h3>Certificate of the plan: {verdict}</h3><p>{certificate.samples} samples along the flight.</p>{table}"


def _provenance(flight: ReportedFlight) -> str:
    return f"<h3>Provenance</h3>{html_table('provenance', flight.provenance)}"
