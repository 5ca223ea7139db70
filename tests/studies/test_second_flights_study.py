"""The study of second flights: on synthetic flights with a known repeated deviation, and on the public ones."""

import json
from pathlib import Path

import numpy as np
import pytest

from cfplan.errors import InputError
from studies.runner.cases import run_study
from studies.second_flights import STUDY, Settings

FLIGHTS = Path(__file__).parents[3] / "shared" / "data" / "flights"
START, DURATION, REST = 0.04, 4.0, 2.0  # s
REPEATS, ALONE = 0.05, 0.01  # m


def run(folder):
    return run_study("second-flights", "studies.second_flights", STUDY, Settings(folder))


def write(folder, name, plan, own):
    """Write a flight along x that deviates by REPEATS in y, a hump, and by `own`, m, as long as the plan lasts."""
    time = np.arange(0.0, START + DURATION + REST, 0.004)
    share = np.clip((time - START) / DURATION, 0.0, 1.0)
    place = np.stack([2.0 * share**3 * (10 - 15 * share + 6 * share**2), 0 * time, 1.0 + 0 * time], axis=1)
    speed = np.stack([60.0 / DURATION * share**2 * (1 - share) ** 2, 0 * time, 0 * time], axis=1)
    hump = np.sin(np.pi * share) ** 2
    flown = place + np.stack([0 * time, (REPEATS + own) * hump, -0.1 - 0 * time], axis=1)
    level = np.tile([0.0, 0.0, 0.0, 1.0], (len(time), 1))
    columns = {
        "time": time, "position": flown, "velocity": speed, "quaternion": level, "gyro": 0 * place,
        "thrust_command": 0 * time, "torque_command": 0 * place, "mocap_time": time[::3], "mocap_position": flown[::3],
        "mocap_quaternion": level[::3], "ref_position": place, "ref_velocity": speed, "ref_acceleration": 0 * place,
        "ref_jerk": 0 * place, "ref_yaw": 0 * time,
    }  # fmt: skip
    np.savez(folder / f"{name}.npz", **columns)
    about = {"family": plan, "mass_weighed": 0.03, "gains": {}, "trajectory": "made up", "reference_start": START,
             "source": {"repository": "none"}, "columns": dict.fromkeys(columns, "")}  # fmt: skip
    (folder / f"{name}.json").write_text(json.dumps(about))


def test_what_repeats_goes_and_what_one_flight_alone_does_stays(tmp_path):
    for name, own in (("first", 0.0), ("second", 0.0), ("third", ALONE)):
        write(tmp_path, name, "brushless-lee-made-up", own)
    write(tmp_path, "single", "brushless-lee-flown-once", 0.0)
    result = run(tmp_path)
    rows = {row.flight: row for row in result.rows}
    assert set(rows) == {"first", "second", "third"}
    hump = np.sqrt(3 / 8)  # rms of sin²
    assert rows["first"].speed == pytest.approx(2.0 * 1.875 / DURATION, rel=0.01)
    assert rows["first"].before == pytest.approx(REPEATS * hump, rel=0.01)
    assert rows["first"].height_before == pytest.approx(0.1, abs=1e-6)
    for name, left in (("first", ALONE / 2), ("second", ALONE / 2), ("third", ALONE)):
        assert rows[name].others == 2
        assert rows[name].least == pytest.approx(left * hump, rel=0.01)
        assert rows[name].after == pytest.approx(left * hump, abs=0.001)
        assert rows[name].height_after == pytest.approx(0.0, abs=1e-6)
    (line,) = result.tables[0].rows
    assert (line["plan"], line["flights"]) == ("brushless-lee-made-up", 3)


def test_a_folder_without_flights_of_one_plan_is_refused(tmp_path):
    write(tmp_path, "single", "brushless-lee-flown-once", 0.0)
    with pytest.raises(InputError, match="flown twice") as refused:
        run(tmp_path)
    assert refused.value.hint


@pytest.mark.skipif(not FLIGHTS.is_dir(), reason="the public flights, ../shared/data/flights, are not here")
def test_public_flights_repeat_until_the_last_second(tmp_path):
    siblings = [f"brushless{number}" for number in range(22, 27)]
    for name in ("brushless00", *siblings):
        for suffix in (".json", ".npz"):
            (tmp_path / name).with_suffix(suffix).symlink_to(FLIGHTS / f"{name}{suffix}")
    rows = run(tmp_path).rows
    assert sorted(row.flight for row in rows) == siblings
    for row in rows:
        assert row.before > 0.1
        assert row.after < 0.04
        assert row.until_end < 1.3 * row.least
    assert np.sqrt(np.mean([row.until_end**2 for row in rows])) < 0.015
