"""Link loss as an assessment: how far beyond the walls each setpoint leaves the vehicle, were it the last one."""

import numpy as np

from cfplan.flight.setpoints.encoding import EncodedFlight
from cfplan.preparation.local_slowing import Assessment, SimulatedLinkLoss
from cfplan.safety.limits import Limits
from cfplan.simulation.link_loss import WALLS, link_loss_at_every_setpoint

MARGIN = 0.02  # m inside the walls that planning aims at: what the last refinement changes stays within
OUTSIDE_HINT = (
    "keep the path farther from that wall; in a room with nets, write `outside: warn` under `link_loss` in safety.yaml"
)
_LEAST_REACH = 1e-3  # m


def assess_link_loss(encoded: EncodedFlight, limits: Limits, margin: float = MARGIN) -> Assessment:
    """Simulate that each setpoint is the last one; what comes down within `margin`, m, of a wall is at fault."""
    moments = link_loss_at_every_setpoint(encoded.payloads, limits)
    number, (axis, side) = np.arange(len(moments.time)), np.array(WALLS)[moments.wall].T
    reach = np.where(side[:, None], moments.high - moments.place, moments.place - moments.low)[number, axis]

    def describe(at: int) -> str:
        far = (
            f"{moments.beyond[at]:.2f} m beyond"
            if moments.beyond[at] > 0.0
            else f"within {-moments.beyond[at]:.2f} m of"
        )
        return f"takes the vehicle {far} {moments.name_of_wall(at, limits)}"

    return Assessment(
        what="link loss",
        time=encoded.times,
        excess=moments.beyond + margin,
        reach=np.maximum(reach, _LEAST_REACH),
        describe=describe,
        near=lambda at: moments.name_of_wall(at, limits),
        hint=OUTSIDE_HINT,
        simulated=SimulatedLinkLoss(encoded.payloads, moments),
    )
