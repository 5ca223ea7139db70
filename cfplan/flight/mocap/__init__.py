"""Poses from motion capture: sources, the Vicon DataStream, and the gates that poses pass."""

__all__ = ["datastream", "frames", "pose_gate", "pose_predictor", "poses", "source", "survey", "uri"]
