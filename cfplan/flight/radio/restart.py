"""Restart a Crazyflie's main processor by radio, through the radio's own processor on board."""

from cfplan.errors import LinkError
from cfplan.flight.clock import REAL_CLOCK, Clock

# In packets of the link port's null channel, handled by the vehicle's radio processor even if the main one is off.
POWER_CHANNEL, POWER = 3, 0xFE
SYSTEM_OFF, SYSTEM_ON = 2, 3
BOOT = 1.0  # s from power-on to the first answer, at most
_ATTEMPTS = 3


def restart_vehicle(uri: str, clock: Clock = REAL_CLOCK) -> None:
    """Switch a vehicle's main processor off and, 1 s later, on; on the ground, with no link open.

    It accepts connections when this returns. Raises LinkError if the vehicle does not confirm.
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
        except Exception as error:  # cflib raises nothing more specific
            if not left:
                raise LinkError(
                    f"the vehicle cannot be restarted: {error}", where=uri, hint="switch it off and on by hand"
                ) from error
