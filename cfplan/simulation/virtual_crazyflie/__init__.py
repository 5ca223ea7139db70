"""A Crazyflie that is not there: the firmware's behaviour on the wire, around a simulated body."""
