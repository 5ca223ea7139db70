"""The numbers that the paper prints: K. Mao et al., "Sequence Modeling for Time-Optimal Quadrotor Trajectory
Optimization with Sampling-based Robustness Analysis" (2025).

SI units; percentages are fractions. A number that the paper prints for train and test together is listed under both.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

from studies.runner.result import Column


def paper_column(
    rows: Mapping[Any, Any], number: str, by: tuple[str, ...], unit: str = "", spec: str = "", meaning: str = ""
) -> Column:
    """Return the column of one of the paper's numbers, looked up by a group's fields `by`; empty if there is none."""

    def printed(group: Sequence[Any]) -> Any:
        key = tuple(getattr(group[0], field) for field in by)
        return getattr(rows.get(key if len(key) > 1 else key[0]), number, None)

    return Column(f"paper_{number}", "paper", unit, spec, meaning=meaning, value=printed)


class PrintedRow(NamedTuple):
    """A planner's numbers in Table 1 or in the appendix's table of inputs."""

    deviation: float  # m, "max dev"
    violation: float  # N, "thrust violation"
    slower: float | None  # "TD ratio"; None for TOPPQuad, for which the paper prints the travel time
    failed: float  # fraction
    seconds: float | None = None  # "compute time"


TRAIN, TEST = "train", "test"
ABOVE_IN_TEXT = 0.023  # m, excess of the LSTM over TOPPQuad in the text; Table 1 gives 0.021 (train) and 0.090 (test)

# Table 1, "Ablation study on model architectures", by its columns.
ARCHITECTURES = MappingProxyType({
    ("TOPPQuad", TRAIN): PrintedRow(0.053, 0.000, None, 0.0, 10.656),
    ("TOPPQuad", TEST): PrintedRow(0.053, 0.000, None, 0.0, 10.656),
    ("LSTM", TRAIN): PrintedRow(0.074, 0.002, -0.0070, 0.02, 0.078),
    ("LSTM", TEST): PrintedRow(0.143, 0.009, -0.0040, 0.04, 0.096),
    ("Transformer", TRAIN): PrintedRow(0.607, 0.135, -0.0850, 0.76, 1.012),
    ("Transformer", TEST): PrintedRow(0.649, 0.123, -0.0235, 0.72, 1.042),
    ("ETransformer", TRAIN): PrintedRow(0.195, 0.012, 0.0189, 0.06, 0.010),
    ("ETransformer", TEST): PrintedRow(0.226, 0.018, 0.0249, 0.04, 0.018),
    ("MLP", TRAIN): PrintedRow(0.252, 0.031, -0.0659, 0.00, 0.005),
    ("MLP", TEST): PrintedRow(0.305, 0.048, -0.0303, 0.06, 0.014),
})  # fmt: skip

# Appendix, "Input Ablation Study", by its columns; all are LSTMs.
INPUTS = MappingProxyType({
    ("TOPPQuad", TRAIN): PrintedRow(0.053, 0.000, None, 0.0),
    ("TOPPQuad", TEST): PrintedRow(0.053, 0.000, None, 0.0),
    ("pos/vel/acc", TRAIN): PrintedRow(0.074, 0.002, -0.0070, 0.02),
    ("pos/vel/acc", TEST): PrintedRow(0.143, 0.009, -0.0040, 0.04),
    ("pos/vel", TRAIN): PrintedRow(0.106, 0.002, -0.0070, 0.04),
    ("pos/vel", TEST): PrintedRow(0.148, 0.005, -0.019, 0.04),
    ("pos/acc", TRAIN): PrintedRow(0.068, 0.003, -0.0090, 0.02),
    ("pos/acc", TEST): PrintedRow(0.164, 0.007, -0.0210, 0.06),
    ("pos", TRAIN): PrintedRow(0.097, 0.008, -0.0070, 0.08),
    ("pos", TEST): PrintedRow(0.225, 0.026, -0.0190, 0.22),
})  # fmt: skip


class PrintedRobustness(NamedTuple):
    """A model's numbers at one scale of perturbation, in Table 2."""

    deviation: float  # m
    slower: float  # "TD ratio", against TOPPQuad
    variation: float  # "output variation"
    in_brt: float  # fraction


# Table 2, "Robustness analysis for the LSTM Encoder-Decoder model", by its columns: model, scale of perturbation, m.
ROBUSTNESS = MappingProxyType({
    ("LSTM", 0.001): PrintedRobustness(0.234, -0.0013, 0.005, 0.900),
    ("LSTM", 0.01): PrintedRobustness(0.790, 0.0133, 0.206, 0.788),
    ("LSTM", 0.1): PrintedRobustness(0.739, 0.0321, 0.306, 0.700),
    ("LSTM-0.01", 0.001): PrintedRobustness(0.094, 0.0008, 0.000, 0.943),
    ("LSTM-0.01", 0.01): PrintedRobustness(0.093, 0.0009, 0.005, 0.945),
    ("LSTM-0.01", 0.1): PrintedRobustness(0.448, 0.0373, 0.089, 0.914),
    ("LSTM-0.1", 0.001): PrintedRobustness(0.127, -0.0007, 0.001, 0.924),
    ("LSTM-0.1", 0.01): PrintedRobustness(0.126, 0.0004, 0.002, 0.930),
    ("LSTM-0.1", 0.1): PrintedRobustness(0.127, 0.0029, 0.013, 0.929),
})  # fmt: skip


class PrintedHardware(NamedTuple):
    """A planner's numbers in the hardware tables."""

    deviation: float  # m, "max deviation"
    time: float  # s, with settling


# The hardware table, and that of the appendix, "Noised Model Hardware Experiments", which repeats the first two.
HARDWARE = MappingProxyType({
    "TOPPQuad": PrintedHardware(0.347, 7.981),
    "LSTM-0.001": PrintedHardware(0.355, 8.355),
    "LSTM-0.01": PrintedHardware(0.372, 8.114),
    "LSTM-0.1": PrintedHardware(0.373, 8.288),
})  # fmt: skip


class PrintedBaseline(NamedTuple):
    """A planner's numbers in Table 3."""

    deviation: float  # m
    thrust_least: float  # N
    thrust_most: float  # N
    violation: float  # N
    time: float  # s
    length: float  # m
    speed: float  # m/s, average
    failed: float  # fraction
    seconds: float  # "compute time"

    @property
    def thrusts(self) -> str:
        """Return least and greatest thrust, N."""
        return f"{self.thrust_least:g} / {self.thrust_most:g}"


# Table 3, the comparison with baselines, by its columns. The paper ran the AllocNet and MFBOTrajectory packages
# themselves.
BASELINES = MappingProxyType({
    "TOPPQuad": PrintedBaseline(0.039, 0.05, 0.14, 0.000, 5.687, 19.772, 3.477, 0.0, 10.083),
    "LSTM": PrintedBaseline(0.124, 0.03, 0.16, 0.002, 5.653, 19.772, 3.498, 0.0, 0.069),
    "LSTM-0.1": PrintedBaseline(0.170, 0.03, 0.17, 0.002, 5.691, 19.772, 3.474, 0.0, 0.101),
    "AllocNet's kind": PrintedBaseline(0.037, 0.06, 0.10, 0.000, 4.066, 11.453, 2.817, 0.28, 0.277),
    "MFBOTrajectory's kind": PrintedBaseline(0.010, 0.07, 0.08, 0.000, 9.431, 16.778, 1.779, 0.0, 13609.913),
})  # fmt: skip
