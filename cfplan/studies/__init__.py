"""Measurements: each study returns a `StudyResult` with tables, which is written to results/ and shown in docs/results.

Studies: bench, feasibility, scaling, learned, unseen_limits, ablation, proposals, long_paths, hard_paths; flights,
dry_runs, exports, lateness, latency, faults, random_faults, link_losses, giving_way, identification, steering, horizon,
physics; in paper/ the paper's tables. They stand on result, provenance, machine and docs_tables (what a study returns,
and where it goes), items and time_left (how its parts are worked through), error_tables, error_texts (docs/errors.md)
and time_outs (docs/what-breaks.md), trials (one planner on one path), adversarial_paths, real_time and sleeper (flights
in the virtual lab), fault_scenarios (the faults), flown_sequence (what a steered flight streamed).
"""

__all__ = [
    "ablation",
    "bench",
    "docs_tables",
    "dry_runs",
    "exports",
    "fault_scenarios",
    "faults",
    "feasibility",
    "flights",
    "giving_way",
    "hard_paths",
    "horizon",
    "identification",
    "items",
    "latency",
    "lateness",
    "learned",
    "link_losses",
    "long_paths",
    "machine",
    "paper",
    "path_robustness",
    "physics",
    "proposals",
    "provenance",
    "random_faults",
    "real_time",
    "result",
    "scaling",
    "steering",
    "stops",
    "time_left",
    "unseen_limits",
]
