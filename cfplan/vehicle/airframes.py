"""Known airframes by name, each number with its source; others are read from a file.

Sources:
  RotorPy    `rotorpy.vehicles.crazyflie_params` and `crazyfliebrushless_params` of RotorPy 3.0.0
  models     `drone_models/data/params.toml` of drone-models 0.1.0: identified on flying vehicles with markers
  firmware   crazyflie-firmware 2026.08: the motor thrust caps, which hold while the battery does (above about 3.1 V)
  flights    public logs of flights, docs/results/real-flights.md: moment and lift with speed, the brushless vehicle's
             drag and inertia, whose yaw is in proportion

A thrust scale belongs to a motor curve. That of the 2.1+ is by the PWM and battery voltage of 2.1s with decks: 1.04 by
the curve of firmware 2026.08, without curvature; 1.02 to 1.09 in the hover of four flights. The upgrade's logs (1.5
times the thrust that a firmware without its curve commands) have no voltage. By the curve of 2026.08 the brushless logs
show 1.3 to 1.4 with a slope of 1.7: they are of other propellers. The scale of these two is 1 until it is measured in
hover. Motor lags are those of `models`: flights show 0.07 to 0.10 s and 0.035 to 0.055 s, which changes nothing
sideways.

Where `models` gives rotor dynamics n' = k₁(u − n) + k₂(u² − n²), up and down apart, the time constant here is the mean
of 1/(k₁ + 2k₂n) of both at the hover speed n: to first order thrust lags as the rotor speed does. The rotor reaction is
its prop_inertia over the slope of its rpm2thrust at hover; RotorPy has none. Without it yaw would be unstable under the
firmware's default gains wherever the time constant exceeds 0.1 s.
"""

import difflib
from pathlib import Path
from types import MappingProxyType

from cfplan.errors import InputError
from cfplan.vehicle.airframe import GRAVITY, Airframe

# platform_defaults_cf2.h and platform_defaults_cf21bl.h of firmware 2026.08: VMOTOR2THRUST0 to 3, THRUST_MAX.
_CURVE_21_PLUS = (-0.02476537915958403, 0.06523793527519485, -0.026792504967750107, 0.006776789303971145, 0.12)
_CURVE_UPGRADE = (0.006728127583707208, 0.01011557616217668, 0.010263198062061085, 0.0028358638322392503, 0.18)
_CURVE_BRUSHLESS = (-0.014058926705279723, 0.04265273261724981, 0.0018327760144017432, 0.0020576974784587178, 0.20)
_LIFT = 0.008  # 1/(m/s)², median of brushed and brushless flights at up to 2.4 m/s
_ROTORPY_HOVER = (0.030 * GRAVITY / 4 / 2.3e-8) ** 0.5  # rad/s, from mass and k_eta

AIRFRAMES = MappingProxyType(
    {
        airframe.name: airframe
        for airframe in (
            Airframe(
                name="crazyflie-2.0",
                mass=0.030,
                inertia=(1.43e-5, 1.43e-5, 2.89e-5),
                arm=0.043 / 2**0.5,
                thrust_to_torque=7.8e-10 / 2.3e-8,  # k_m / k_eta; four times what was measured on the 2.1+
                motor_thrust_min=0.0,
                motor_thrust_max=2.3e-8 * 2500.0**2,  # k_eta · rotor_speed_max², 0.14375 N
                motor_time_constant=0.072,  # Eschmann et al. (2024); RotorPy had 0.005 s when the paper was written
                drag=(4 * 1.02506e-6 * _ROTORPY_HOVER, 4 * 7.553e-7 * _ROTORPY_HOVER),  # k_d and k_z at hover
                source="RotorPy 3.0.0, as the paper used it but for the motor time constant (0.005 s then)",
            ),
            Airframe(
                name="crazyflie-2.1+",
                mass=0.0318,
                inertia=(16.8e-6, 16.8e-6, 29.8e-6),
                arm=0.046 / 2**0.5,
                thrust_to_torque=0.0069928948992470565,
                motor_thrust_min=0.012817578393224994,
                motor_thrust_max=0.12,
                motor_time_constant=0.105,
                drag=(0.01351483, 0.01677452),
                source="drone-models 0.1.0 cf2x_P250; moment, scale, lift: public flights; cap of firmware 2026.08",
                rotor_reaction=3.98e-4,
                velocity_moment=(4.9e-4, 6.0e-4),
                thrust_scale=1.04,
                lift_with_speed=_LIFT,
                motor_curve=_CURVE_21_PLUS,
            ),
            Airframe(
                name="crazyflie-thrust-upgrade",
                mass=0.0379,
                inertia=(16.8e-6, 16.8e-6, 29.8e-6),  # not measured; that of the 2.1
                arm=0.046 / 2**0.5,
                thrust_to_torque=0.005355990836477486,
                motor_thrust_min=0.01922636758983749,
                motor_thrust_max=0.18,
                motor_time_constant=0.079,
                drag=(0.01556697, 0.02191672),
                source="drone-models 0.1.0 cf2x_T350; moment, lift: public flights; thrust cap of firmware 2026.08",
                rotor_reaction=3.89e-4,
                velocity_moment=(4.6e-4, 5.5e-4),
                lift_with_speed=_LIFT,
                motor_curve=_CURVE_UPGRADE,
            ),
            Airframe(
                name="crazyflie-2.1-brushless",
                mass=0.04338,
                inertia=(20e-6, 21e-6, 38e-6),
                arm=0.050 / 2**0.5,
                thrust_to_torque=0.00593893393599368,
                motor_thrust_min=0.02136263065537499,
                motor_thrust_max=0.20,
                motor_time_constant=0.060,
                drag=(0.36 * 0.04338, 0.37 * 0.04338),
                source="drone-models 0.1.0 cf21B_500; drag, inertia, moment, lift: flights; cap of firmware 2026.08",
                rotor_reaction=2.98e-4,
                velocity_moment=(4.9e-4, 6.5e-4),
                lift_with_speed=_LIFT,
                motor_curve=_CURVE_BRUSHLESS,
            ),
        )
    }
)


def load_airframe(name_or_file: str | Path) -> Airframe:
    """Return the airframe of that name, or read the one that a YAML file describes. Raises InputError."""
    text = str(name_or_file)
    if text in AIRFRAMES:
        return AIRFRAMES[text]
    if isinstance(name_or_file, Path) or text.endswith((".yaml", ".yml")):
        from cfplan.vehicle.airframe_file import read_airframe  # pydantic is slow to import

        return read_airframe(text)
    near = difflib.get_close_matches(text, AIRFRAMES, n=1)
    guess = f"did you mean {near[0]}? " if near else ""
    raise InputError(
        f"unknown vehicle {text!r}", hint=f"{guess}known: {', '.join(AIRFRAMES)}, or a .yaml file of your own"
    )
