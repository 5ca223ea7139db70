"""The bits of the log variable supervisor.info, as the firmware's supervisor.c sets them."""

CAN_BE_ARMED = 1 << 0
ARMED = 1 << 1
CAN_FLY = 1 << 3
FLYING = 1 << 4
TUMBLED = 1 << 5
LOCKED = 1 << 6
CRASHED = 1 << 7
HIGH_LEVEL_ACTIVE = 1 << 8
TRAJECTORY_FINISHED = 1 << 9
HIGH_LEVEL_DISABLED = 1 << 10
DECK_FAULT = 1 << 11  # from firmware 2026.08 on

FAULTS = {TUMBLED: "tumbled", LOCKED: "locked", CRASHED: "crashed", DECK_FAULT: "reports a fault of a deck"}
