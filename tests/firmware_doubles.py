"""Other implementations of the firmware: one that has nothing but the interface, and one in C.

`CFPLAN_FIRMWARE=firmware_doubles:Counting PYTHONPATH=tests pytest …` runs tests on the first.
"""

from collections import Counter

from cfplan.simulation.virtual_crazyflie.virtual_firmware import VirtualFirmware


class Counting:
    """Forwards the calls of the interface, and nothing else, to cfplan's own firmware, and counts them."""

    def __init__(self, airframe, settings):
        self._inner = VirtualFirmware(airframe, settings)
        self.calls = Counter()

    @property
    def supervisor_state(self):
        return int(self._inner.supervisor_state)

    def tick(self, gyroscope, accelerometer, without_vibration, voltage):
        self.calls["tick"] += 1
        commands = self._inner.tick(gyroscope, accelerometer, without_vibration, voltage)
        return None if commands is None else commands.tolist()

    def receive(self, packet):
        self.calls["receive"] += 1
        self._inner.receive(packet)

    def sent(self):
        packets = self._inner.sent()
        self.calls["sent"] += len(packets)
        return packets

    def restart(self):
        self.calls["restart"] += 1
        self._inner.restart()


class Failing(Counting):
    """One in which faults can be simulated, too."""

    def fail(self, faults):
        self._inner.fail(faults)


class Reversed(Counting):
    """A firmware whose echo is reversed, to distinguish it from cfplan's own."""

    def sent(self):
        return [packet[:1] + packet[:0:-1] for packet in super().sent()]


# Keeps itself level by its gyroscope, with the PWM that the last packet named; answers each packet by the packet.
IN_C = r"""
#include <string.h>

static double roll, pitch, base;
static unsigned char waits[32];
static int waiting, state;

void firmware_restart(void) { roll = pitch = base = 0; waiting = 0; state = 2; }

void firmware_receive(const unsigned char *packet, int length) {
    memcpy(waits, packet, length);
    waiting = length;
    if (length == 3) base = packet[1] | packet[2] << 8;
    state = base > 0 ? 5 : 6;
}

int firmware_send(unsigned char packet[32]) {
    int length = waiting;
    memcpy(packet, waits, length);
    waiting = 0;
    return length;
}

int firmware_supervisor_state(void) { return state; }

int firmware_tick(const double gyroscope[3], const double accelerometer[3], double voltage, double pwm[4]) {
    static const double about_x[4] = {-1, -1, 1, 1}, about_y[4] = {-1, 1, 1, -1};
    roll += 1e-3 * gyroscope[0];
    pitch += 1e-3 * gyroscope[1];
    double x = 38 * (-30 * roll - 10 * gyroscope[0]), y = 38 * (-30 * pitch - 10 * gyroscope[1]);
    for (int i = 0; i < 4; i++) pwm[i] = base > 0 ? base + about_x[i] * x + about_y[i] * y : 0;
    return base > 0;
}
"""
