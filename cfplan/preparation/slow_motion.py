"""Link loss in slow motion: the vehicle must come down inside the walls also from take-off, the way to the start, and
landing.

The position before take-off is not known yet. The worst cases are a way straight towards a wall or away from one, of
exactly the length that takes the shortest manoeuvre time, as it accelerates most, and a take-off beside two walls.
Therefore ways of this length to the start from all sides, from each wall and from each corner are simulated, and
take-offs there. Ways with an obstacle on or below them are left out, as preflight refuses these, and so are ways that
begin close to an obstacle: between a wall and an obstacle the vehicle leans away from each towards the other.
"""

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import NotCertifiedError
from cfplan.flight.pilot.mission import Mission, go_to_time, manoeuvre_time
from cfplan.flight.setpoints.commitment import QUANTUM
from cfplan.flight.setpoints.descent import descent, gentle
from cfplan.flight.setpoints.encoding import encode_motion
from cfplan.flight.setpoints.hover_to_hover import hover_to_hover
from cfplan.flight.setpoints.rate_trade import ahead, gains_under
from cfplan.flight.telemetry import Triple
from cfplan.numbers import coordinates
from cfplan.preparation.steps import OnStep, ignore_steps, step
from cfplan.safety.limits import SHORTEST_MANOEUVRE
from cfplan.safety.space import Space, inside
from cfplan.simulation.link_loss import link_loss_of_slow_motion

_TURN = np.pi / 2  # rad, of the vehicle on its way to the start
_PLACES = 200  # on the way to the start, checked for obstacles
_TAKE_OFF_CLEARANCE = 0.3  # m, beyond the margin, between obstacles and a take-off that is simulated
_BENEATH_FLOOR = 0.3  # m below the floor, where a landing's setpoints end
_NETS = "in a room with nets, write `outside: warn` under `link_loss` in safety.yaml"
_TAKE_OFF_HINT = f"lower `ground.take_off_speed`, or widen `space.margin`; {_NETS}"
_START_HINT = f"lower `ground.go_to_speed`, or begin the path farther from there; {_NETS}"
_LANDING_HINT = f"end the path farther from there; {_NETS}"

_Motion = tuple[str, str, NDArray]  # name, hint, payloads


def require_harmless_slow_motion(mission: Mission, on_step: OnStep = ignore_steps) -> None:
    """Simulate link loss in take-off, on the way to the start, and in landing after the mission.

    Raises NotCertifiedError if the vehicle comes down outside the walls, unless safety.yaml says only to warn, and if
    the landing ends on an obstacle.
    """
    limits, farthest, worst = mission.limits, -np.inf, ""
    with step(on_step, "slow phases") as results:
        _require_clear_landing(mission)
        for what, hint, payloads in _motions(mission):
            moments = link_loss_of_slow_motion(payloads, limits, mission.rate)
            at = int(np.argmax(np.where(np.isnan(moments.beyond), np.inf, moments.beyond)))
            beyond = float(moments.beyond[at])
            if not beyond <= farthest:
                farthest, worst = beyond, f"{what} ends {limits.space.describe(beyond, int(moments.face[at]))}"
            if not inside(beyond) and not limits.link_loss.only_warn:
                raise NotCertifiedError(f"link loss {worst}", where="link loss", hint=hint)
        (results.append if inside(farthest) else results.warn)(f"link loss {worst}, at worst")


def _motions(mission: Mission) -> Iterator[_Motion]:
    space, ground, height = mission.limits.space, mission.limits.ground, mission.take_off_height
    (x, y, z), yaw = mission.start
    beside = replace(
        space, low=(-np.inf, -np.inf, space.low[2]), high=(np.inf,) * 3, margin=space.margin + _TAKE_OFF_CLEARANCE
    )
    low, high = np.add(space.low, space.margin), np.subtract(space.high, space.margin)
    sides = [(low[0], y), (high[0], y), (x, low[1]), (x, high[1])]
    corners = list(product((low[0], high[0]), (low[1], high[1])))
    for side, other in corners[::3]:  # two of them face all walls
        if not _clear((side, other, height), (side, other, height), beside):
            continue
        begin, above = (float(side), float(other), space.low[2]), (float(side), float(other), height)
        climb = manoeuvre_time(height - space.low[2], ground.take_off_speed)
        yield f"in take-off at {_text(begin)}", _TAKE_OFF_HINT, _way(begin, above, yaw, yaw, climb, mission)
    reach = np.sqrt(max((SHORTEST_MANOEUVRE * ground.go_to_speed) ** 2 - (z - height) ** 2, 0.0))
    near = [np.clip((x + a * reach, y + b * reach), low[:2], high[:2]) for a, b in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    for place in [*near, *sides, *corners]:
        begin = (float(place[0]), float(place[1]), height)
        if not (_clear(begin, begin, beside) and _clear(begin, (x, y, z), space)):
            continue
        duration = go_to_time(math.dist((x, y, z), begin), _TURN, mission.limits)
        way = _way(begin, (x, y, z), yaw + _TURN, yaw, duration, mission)
        yield f"on the way from {_text(begin)} to the start", _START_HINT, way
    end, end_yaw = mission.end
    floor, pace = space.low[2], gentle(ground.land_speed)
    lowest = floor - _BENEATH_FLOOR
    down = descent(end, end_yaw, 0.0, pace, floor, lowest, limits=mission.limits, rate=mission.rate)
    yield f"in landing at {_text(end)}", _LANDING_HINT, down


def _clear(begin: Triple, end: Triple, space: Space) -> bool:
    """Return whether a way and the space below it are clear of obstacles; preflight refuses others."""
    if not space.obstacles:
        return True
    way = np.linspace(begin, end, _PLACES)
    return bool(inside(space.above_floor(way)[0], QUANTUM).all())


def _require_clear_landing(mission: Mission) -> None:
    """Raise NotCertifiedError if an obstacle is below the end of the path."""
    space, (end, _) = mission.limits.space, mission.end
    if not _clear(end, end, space):
        (beyond,), (face,) = space.above_floor(np.array([end]))
        raise NotCertifiedError(
            f"the landing at {_text(end)} is {beyond:.2f} m too {space.too(face)}",
            where="landing", hint="end the path above the free floor",
        )  # fmt: skip


def _way(begin: Triple, end: Triple, yaw: float, end_yaw: float, duration: float, mission: Mission) -> NDArray:
    limits, rate = mission.limits, mission.rate
    motion = hover_to_hover(begin, yaw, end, end_yaw, duration, rate)
    return encode_motion(motion, ahead(motion.acceleration, rate), gains_under(limits), space=limits.space)


def _text(place: Triple) -> str:
    return f"{coordinates(place, '.2f')} m"
