"""The layout of the rerun view: the name of each entity, and the blueprint."""

import math
from typing import Literal

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumn, TimelineColumn

from cfplan.recording.header import RecordHeader
from cfplan.recording.plots import TITLES

TIMELINE = "flight"
WORLD = "world"
FENCE = f"{WORLD}/fence"
FLOOR = f"{WORLD}/floor"
OBSTACLES = f"{WORLD}/obstacles"
PATH = f"{WORLD}/path"
COMMITTED = f"{WORLD}/committed"
FLOWN = f"{WORLD}/flown"
TAIL = f"{WORLD}/flown_tail"
BODY = f"{WORLD}/vehicle"
THRUST = f"{BODY}/thrust"
GHOST = f"{WORLD}/setpoint"
WANTED_TAIL = f"{WORLD}/setpoint_tail"
PIECES = f"{WORLD}/plan/pieces"
JOINTS = f"{WORLD}/plan/joints"
LIMITS = f"{WORLD}/plan/limit"
PLOTS = "plots"
PHASES = "phase"
SUPERVISOR = "supervisor"
ACTIVE_LIMIT = "limit"
EVENTS = "events"
SUMMARY = "summary"

TAIL_SECONDS = 2.0
LONG_IN_Y, LONG_IN_X = (0.76, -0.20, 0.52), (-0.20, -0.76, 0.52)
"""Camera positions from the room's centre, in lengths of its diagonal, from which all of the room is in sight."""
PlayState = Literal["paused", "playing", "following"]
_STATES = "Phases, limit that holds the plan back, supervisor"


def blueprint(
    header: RecordHeader, *, play_state: PlayState = "paused", span: tuple[float, float] | None = None
) -> rrb.Blueprint:
    """Return the layout: 3-D at the left, the plots beside it in two columns, phases, events and the summary below.

    All plots show `span`, s on the timeline, if it is given: a flight in progress has none.
    """
    grid = rrb.Grid(*(time_plot(name, title, span) for name, title in TITLES.items()), grid_columns=2)
    below = rrb.Horizontal(
        rrb.StateTimelineView(contents=[PHASES, ACTIVE_LIMIT, SUPERVISOR], name=_STATES),
        rrb.Tabs(
            rrb.TextLogView(origin=EVENTS, name="Events", columns=event_columns()),
            rrb.TextDocumentView(origin=SUMMARY, name="Summary"),
        ),
        column_shares=[3, 2],
    )
    return rrb.Blueprint(
        rrb.Vertical(rrb.Horizontal(_room(header), grid, column_shares=[6, 5]), below, row_shares=[5, 1]),
        rrb.TimePanel(timeline=TIMELINE, state="collapsed", play_state=play_state),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
    )


def event_columns() -> rrb.TextLogColumns:
    """Return the columns of a list of events: level and text, which begins with the time."""
    return rrb.TextLogColumns(
        timeline_columns=[TimelineColumn(TIMELINE, visible=False)],
        text_log_columns=[TextLogColumn("LogLevel"), TextLogColumn("Body")],
    )


def time_plot(name: str, title: str, span: tuple[float, float] | None = None) -> rrb.TimeSeriesView:
    """Return one set of axes over `span`, s, or over what it holds; its legend covers the time on the ground."""
    axis = None
    if span is not None and all(map(math.isfinite, span)):
        begin, end = (rrb.TimeRangeBoundary.absolute(seconds=moment) for moment in span)
        axis = rrb.TimeAxis(view_range=rr.TimeRange(begin, end))
    legend = rrb.PlotLegend("LeftTop")
    return rrb.TimeSeriesView(origin=f"{PLOTS}/{name}", name=title, plot_legend=legend, axis_x=axis)


def _room(header: RecordHeader) -> rrb.Spatial3DView:
    """Return the 3-D view from above one of the room's long sides, with the whole fence in sight."""
    low, high = np.array(header.fence)
    centre, size = (low + high) / 2, float(np.linalg.norm(high - low))
    target = (*centre[:2], low[2] + 0.1 * (high - low)[2])
    aside = LONG_IN_Y if high[1] - low[1] > high[0] - low[0] else LONG_IN_X
    ever = rrb.VisibleTimeRange(
        TIMELINE, start=rrb.TimeRangeBoundary.infinite(), end=rrb.TimeRangeBoundary.cursor_relative(seconds=0.0)
    )
    return rrb.Spatial3DView(
        origin=WORLD,
        name=header.name,
        overrides={
            TAIL: [tail_range()],
            WANTED_TAIL: [tail_range()],
            FLOWN: [rrb.VisibleTimeRanges([ever])],
        },
        line_grid=False,
        eye_controls=rrb.EyeControls3D(
            position=centre + size * np.array(aside), look_target=target, eye_up=(0.0, 0.0, 1.0)
        ),
    )


def tail_range() -> rrb.VisibleTimeRanges:
    """Return the range in which a tail is shown: the last TAIL_SECONDS."""
    tail = rrb.VisibleTimeRange(
        TIMELINE,
        start=rrb.TimeRangeBoundary.cursor_relative(seconds=-TAIL_SECONDS),
        end=rrb.TimeRangeBoundary.cursor_relative(seconds=0.0),
    )
    return rrb.VisibleTimeRanges([tail])
