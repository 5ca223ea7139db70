"""Records of flights: written as they happen, read back, summarised."""

__all__ = [
    "animation",
    "commitments",
    "fleet_record",
    "flight_figure",
    "header",
    "importers",
    "mavlink",
    "overlay",
    "plots",
    "public_topics",
    "reader",
    "record",
    "report",
    "rerun",
    "summary",
    "writer",
]
