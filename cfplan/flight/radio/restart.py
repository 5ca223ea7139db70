"""Restart a Crazyflie's main processor by radio, through the radio's own processor on board."""

from cfplan.errors import LinkError
from cfplan.flight.clock import REAL_CLOCK, Clock

# In a packet for the link port's null channel; the vehicle's radio processor obeys it, its main processor need not run.
POWER_CHANNEL, POWER = 3, 0xFE
SYSTEM_OFF, SYSTEM_ON = 2, 3
BOOT = 1.0  # s from power on until it answers, at most
_ATTEMPTS = 3


def restart_vehicle(uri: str, clock: Clock = REAL_CLOCK) -> None:
    """Switch a vehicle's main processor off and, 1 s later, on; on the ground, with no link open.

    It is back when this returns, and answers whoever connects next. Raises LinkError if the vehicle does not confirm.
    """
    from cflib.utils.power_switch import PowerSwitch

    for left in reversed(range(_ATTEMPTS)):
        try:
            switch = PowerSwitch(uri.partition("?")[0])
            try:
                switch.stm_power_cycle()
            finally:
                switch.close()
            clock.sleep(BOOT)
            return
        except Exception as error:  # cflib raises nothing more precise
            if not left:
                raise LinkError(
                    f"the vehicle cannot be restarted: {error}", where=uri, hint="switch it off and on by hand"
                ) from error
