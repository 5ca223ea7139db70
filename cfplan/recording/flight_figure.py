"""A recorded flight as a figure for print, over the plan that it flew."""

from typing import TYPE_CHECKING

import numpy as np

from cfplan.planning.figure import Flown, draw_plan
from cfplan.planning.plan_file import load_plan
from cfplan.recording.record import PLAN_FILE, Record
from cfplan.recording.summary import deviation, reference_span

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_flight(record: Record) -> "Figure":
    """Return the figure of a flight along its plan.

    Raises:
        InputError: there is no plan beside the record, or nothing of it was flown.
    """
    plan = load_plan(record.folder / PLAN_FILE)
    begin, end = reference_span(record)
    off = deviation(record, begin, end)
    at = np.isin(record.poses.time, off.time)
    return draw_plan(plan, record.header.name, Flown(off.time - begin, record.poses.position[at], off.in_time))
