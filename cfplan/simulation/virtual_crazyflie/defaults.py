"""The values that parameters have after power-up, and those of them that reach the inner loop."""

from cfplan.flight.firmware import GAIN_PARAMETERS, MellingerGains
from cfplan.simulation.engine.kalman import Prior
from cfplan.simulation.engine.pid import default_gains, default_limits
from cfplan.simulation.virtual_crazyflie.collision_avoidance import FARTHEST

PID, MELLINGER = 1, 2
COMPLEMENTARY, KALMAN = 1, 2

# Parameters in the order in which the compiled loop has them.
PRIOR_PARAMETERS = tuple(
    "kalman." + name
    for name in (
        "pNAcc_xy", "pNAcc_z", "pNVel", "pNPos", "pNAtt", "mNGyro_rollpitch", "mNGyro_yaw", "initialX", "initialY",
        "initialZ", "initialYaw", "maxPos", "maxVel", "dragB_x", "dragB_y", "dragB_z",
    )
)  # fmt: skip

_GAIN_NAMES = ("p", "i", "d")
# The PID controller's gains in the order of its loops, and its limits; the limits inside the loops are scaled ones.
PID_GAIN_PARAMETERS = tuple(
    tuple(f"{group}{gain}" for gain in _GAIN_NAMES)
    for group in (
        "posCtlPid.xK", "posCtlPid.yK", "posCtlPid.zK", "velCtlPid.vxK", "velCtlPid.vyK", "velCtlPid.vzK",
        "pid_attitude.roll_k", "pid_attitude.pitch_k", "pid_attitude.yaw_k",
        "pid_rate.roll_k", "pid_rate.pitch_k", "pid_rate.yaw_k",
    )
)  # fmt: skip
PID_LIMIT_PARAMETERS = (
    "posCtlPid.rLimit", "posCtlPid.pLimit", "posCtlPid.thrustBase", "posCtlPid.thrustMin", "pid_attitude.yawMaxDelta",
)  # fmt: skip
PID_SPEED_PARAMETERS = ("posCtlPid.xVelMax", "posCtlPid.yVelMax", "posCtlPid.zVelMax")


def _pid_defaults() -> dict[str, float]:
    found = dict(zip(PID_LIMIT_PARAMETERS, default_limits(), strict=True))
    for names, row in zip(PID_GAIN_PARAMETERS, default_gains(), strict=True):
        found |= dict(zip(names, row[:3], strict=True))
    return found | dict.fromkeys(PID_SPEED_PARAMETERS, 1.0)


DEFAULTS: dict[str, float] = {
    **dict(zip(GAIN_PARAMETERS, MellingerGains().pack(), strict=True)),
    **dict(zip(PRIOR_PARAMETERS, Prior().pack(), strict=True)),
    "stabilizer.controller": PID,
    "stabilizer.estimator": COMPLEMENTARY,
    **{f"colAv.ellipsoid{axis}": radius for axis, radius in zip("XYZ", (0.3, 0.3, 0.9), strict=True)},
    **{f"colAv.bbox{end}{axis}": far for end, far in (("Min", -FARTHEST), ("Max", FARTHEST)) for axis in "XYZ"},
    "colAv.horizon": 1.0,
    "colAv.maxSpeed": 0.5,
    "colAv.sidestepThrsh": 0.25,
    "colAv.maxPeerLocAge": 5000,
    "colAv.vorTol": 1e-5,
    "colAv.vorIters": 100,
    "supervisor.tmblChckEn": 1,
    "supervisor.prefltTimeout": 30000,
    "supervisor.landedTimeout": 3000,
    "supervisor.spinupTimeout": 2000,
    "locSrv.extPosStdDev": 0.01,
    "locSrv.extQuatStdDev": 4.5e-3,
    "hlCommander.vtoff": 0.5,
    "hlCommander.vland": 0.5,
    "pm.lowVoltage": 3.2,
    "pm.criticalLowVoltage": 3.0,
    "flightmode.stabModeRoll": 1,
    "flightmode.stabModePitch": 1,
    "flightmode.yawMode": 2,
    "system.selftestPassed": 1,
    "kalman.mNBaro": 2.0,
    **_pid_defaults(),
}
