"""Draw random vehicles and limits in the range that people fly, each from a seed.

A quarter of the vehicles are the known ones, a quarter are these with a load, and half are made up: their inertia is
that of a body of about their size, their motors lift 1.4 to 4 times their weight. Limits are drawn independently of
each other, within the ranges below, where all orders of magnitude are equally likely; a quarter of them are those of a
limit set instead, each number somewhat changed, as people edit a file. Hovering always has some room.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cfplan.safety.limit_sets import LIMIT_SETS, LimitSet
from cfplan.safety.limits import PlanLimits, within_reserve
from cfplan.safety.space import Space
from cfplan.vehicle.airframe import GRAVITY, Airframe
from cfplan.vehicle.airframes import AIRFRAMES

SPEED = (0.3, 8.0)  # m/s
ACCELERATION = (1.0, 20.0)  # m/s²
ANGULAR_VELOCITY = (2.0, 25.0)  # rad/s
ANGULAR_ACCELERATION = (10.0, 300.0)  # rad/s²
UNLIMITED_TURNING = 0.15  # fraction of the draws without a limit on angular acceleration
TILT = (15.0, 85.0)  # degrees
RESERVE = (0.0, 0.4)  # of each motor's range
SPECIFIC_THRUST = (0.1, 0.8)  # g
MASS = (0.020, 0.080)  # kg
LOAD = (0.95, 1.25)  # times a known vehicle's mass
THRUST_TO_WEIGHT = (1.4, 4.0)
KNOWN, LOADED = 0.25, 0.25  # fractions of the vehicles
EDITED, EDIT = 0.25, 0.2  # fraction of the limits that are edited; spread of the logarithm of an edit
WALLS = (0.1, 3.0)  # m, between the waypoints and each wall of a room
HOVER_ROOM = 0.1  # of the thrust in hover: left between it and the limits of motor thrust at least


def draw_limit_set(random: np.random.Generator) -> LimitSet:
    """Draw a vehicle, and limits for it under which it hovers with some room."""
    edited = random.uniform() < EDITED
    if edited:
        known = list(LIMIT_SETS.values())[int(random.integers(len(LIMIT_SETS)))]
        airframe = known.airframe if random.uniform() < 0.5 else draw_airframe(random)
        return LimitSet("drawn", airframe, edit_limits(random, known, airframe))
    airframe = draw_airframe(random)
    return LimitSet("drawn", airframe, draw_limits(random, airframe))


def draw_airframe(random: np.random.Generator) -> Airframe:
    """Draw a vehicle: a known one, one with a load, or one made up."""
    kind, known = random.uniform(), list(AIRFRAMES.values())[int(random.integers(len(AIRFRAMES)))]
    if kind < KNOWN:
        return known
    if kind < KNOWN + LOADED:
        return replace(known, name=f"{known.name}, loaded", mass=known.mass * random.uniform(*LOAD), source="drawn")
    mass, arm = _logarithmic(random, MASS), random.uniform(0.025, 0.060)
    roll = mass * arm**2 * random.uniform(0.3, 0.8)
    pitch = roll * random.uniform(0.85, 1.2)
    most = random.uniform(*THRUST_TO_WEIGHT) * mass * GRAVITY / 4
    sideways = mass * random.uniform(0.0, 0.8)
    return Airframe(
        name="made up",
        mass=mass,
        inertia=(roll, pitch, (roll + pitch) * random.uniform(0.75, 0.99)),
        arm=arm,
        thrust_to_torque=_logarithmic(random, (0.004, 0.035)),
        motor_thrust_min=random.uniform(0.0, 0.2) * mass * GRAVITY / 4,
        motor_thrust_max=most,
        motor_time_constant=random.uniform(0.04, 0.12),
        drag=(sideways, sideways * random.uniform(0.7, 1.5)),
        source="drawn",
    )


def draw_limits(random: np.random.Generator, airframe: Airframe) -> PlanLimits:
    """Draw limits for a vehicle."""
    unlimited = random.uniform() < UNLIMITED_TURNING
    return PlanLimits(
        speed=_logarithmic(random, SPEED),
        acceleration=_logarithmic(random, ACCELERATION),
        angular_velocity=_logarithmic(random, ANGULAR_VELOCITY),
        angular_acceleration=math.inf if unlimited else _logarithmic(random, ANGULAR_ACCELERATION),
        tilt=math.radians(random.uniform(*TILT)),
        specific_thrust_min=GRAVITY * random.uniform(*SPECIFIC_THRUST),
        **within_reserve(airframe, random.uniform(RESERVE[0], max(RESERVE[0], min(RESERVE[1], _room(airframe))))),
    )


def edit_limits(random: np.random.Generator, known: LimitSet, airframe: Airframe) -> PlanLimits:
    """Change the limits of a known set at random, for a vehicle."""
    least, most = known.airframe.thrust_range
    reserve = (most - known.limits.motor_thrust_max) / (most - least)
    changed = {
        name: getattr(known.limits, name) * math.exp(random.normal(scale=EDIT))
        for name in ("speed", "acceleration", "angular_velocity", "angular_acceleration", "tilt")
    }
    changed["tilt"] = min(changed["tilt"], math.radians(TILT[1]))
    return replace(known.limits, **changed, **within_reserve(airframe, max(0.0, min(reserve, _room(airframe)))))


def draw_space(random: np.random.Generator, waypoints: NDArray) -> Space:
    """Draw a room around waypoints, (K, 3) m: from walls that bind the path to walls that it does not reach."""
    low, high = ([_logarithmic(random, WALLS) for _ in range(3)] for _ in range(2))
    return Space(
        tuple((waypoints.min(axis=0) - low).tolist()), tuple((waypoints.max(axis=0) + high).tolist()), margin=0.0
    )


def _room(airframe: Airframe) -> float:
    """Return the largest reserve that leaves hovering room."""
    hover, (least, most) = airframe.hover_thrust, airframe.thrust_range
    return min(hover * (1 - HOVER_ROOM) - least, most - hover * (1 + HOVER_ROOM)) / (most - least)


def _logarithmic(random: np.random.Generator, ends: tuple[float, float]) -> float:
    """Draw a number whose logarithm is uniform."""
    return math.exp(random.uniform(math.log(ends[0]), math.log(ends[1])))
