"""Safety: limits from safety.yaml, the space, the certificate, and slowing until it passes."""

__all__ = [
    "certificate",
    "feasibility",
    "limit_sets",
    "limits",
    "limits_file",
    "quantities",
    "slowing",
    "space",
    "speed_caps",
]
