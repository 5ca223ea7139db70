"""Prints when this computer stood still, by time.monotonic(): when a process that only sleeps woke late."""

import time

from cfplan.flight.pace import go_first

PERIOD = 0.005
# s
STANDSTILL = 0.02
# s late

if __name__ == "__main__":
    go_first()
    while True:
        due = time.monotonic() + PERIOD
        time.sleep(PERIOD)
        now = time.monotonic()
        if now - due > STANDSTILL:
            print(now, flush=True)
