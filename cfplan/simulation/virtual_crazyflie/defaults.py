"""The values that parameters have after power-up, and those of them that reach the inner loop."""

from dataclasses import fields

from cfplan.simulation.estimator import Prior
from cfplan.simulation.mellinger import MellingerGains

PID, MELLINGER = 1, 2
COMPLEMENTARY, KALMAN = 1, 2

# Parameters in the order in which the compiled loop has them.
GAIN_PARAMETERS = tuple(
    "ctrlMel." + {"mass_thrust": "massThrust"}.get(each.name, each.name) for each in fields(MellingerGains)
)
PRIOR_PARAMETERS = tuple(
    "kalman." + name
    for name in (
        "pNAcc_xy", "pNAcc_z", "pNVel", "pNPos", "pNAtt", "mNGyro_rollpitch", "mNGyro_yaw", "initialX", "initialY",
        "initialZ", "initialYaw", "maxPos", "maxVel", "dragB_x", "dragB_y", "dragB_z",
    )
)  # fmt: skip

DEFAULTS: dict[str, float] = {
    **dict(zip(GAIN_PARAMETERS, MellingerGains().pack(), strict=True)),
    **dict(zip(PRIOR_PARAMETERS, Prior().pack(), strict=True)),
    "stabilizer.controller": PID,
    "stabilizer.estimator": COMPLEMENTARY,
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
    "posCtlPid.xKp": 2.0,
    "posCtlPid.yKp": 2.0,
    "posCtlPid.zKp": 2.0,
    "posCtlPid.zKi": 0.5,
    "posCtlPid.xVelMax": 1.0,
    "posCtlPid.yVelMax": 1.0,
    "posCtlPid.zVelMax": 1.0,
    "posCtlPid.rLimit": 20.0,
    "posCtlPid.pLimit": 20.0,
    "posCtlPid.thrustBase": 36000,
    "posCtlPid.thrustMin": 20000,
}
