"""The study of stops: straight on from full speed, those that a request does not try lean too far."""

from pathlib import Path

from cfplan.studies.stops import stops

ROOT = Path(__file__).parents[2]


def test_shorter_stops_from_full_speed_lean_too_far():
    rows = stops(ROOT / "safety.yaml", durations=(0.43, 0.54)).table("stops").rows
    short, flown = rows
    assert not flown["refused"]
    assert flown["tilt"] < 35.0
    assert abs(flown["distance"] - 0.54) < 0.01  # as many metres as seconds at 2 m/s
    assert "tilt" in short["refused"]
    assert short["tilt"] > 40.0
