"""From a certified plan to a landed vehicle: setpoints, radio, motion capture and the pilot."""

__all__ = ["clock", "firmware", "fleet", "mocap", "on_board", "pilot", "radio", "real_time", "setpoints", "telemetry"]
