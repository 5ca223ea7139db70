"""The command for perturbations of a path of one's own."""

import json
from pathlib import Path

from click.testing import CliRunner

from cfplan.cli import cfplan
from cfplan.geometry.path_file import load_path_file
from cfplan.safety.limits_file import load_limits
from studies.path_robustness import path_robustness

REPOSITORY = Path(__file__).parents[2]


def test_a_path_of_ones_own_hardly_changes_its_flight_where_it_hardly_changes():
    path_file = load_path_file(REPOSITORY / "flights" / "line.yaml")
    found = path_robustness(path_file, load_limits(REPOSITORY / "safety.yaml"), scales=(1e-4, 0.02), draws=2)
    little, more = found.table("robustness").rows
    assert little["certified"] == little["flown"] == little["plans"] == 2
    assert abs(little["longer_most"]) < 0.01
    assert little["faster"] < more["faster"]
    again = path_robustness(path_file, load_limits(REPOSITORY / "safety.yaml"), scales=(1e-4,), draws=1)
    assert again.table("plans").rows[0] == found.table("plans").rows[0]


def test_the_command_says_what_is_refused(tmp_path):
    done = CliRunner().invoke(
        cfplan,
        ["robustness", str(REPOSITORY / "flights" / "line.yaml"), "--epsilon", "3", "--draws", "1", "--json"],
    )
    assert done.exit_code == 0, done.output
    (plans,) = json.loads(done.output)["details"]
    reason = plans["rows"][0][[column["key"] for column in plans["columns"]].index("reason")]
    assert "space" in reason  # moved by metres it leaves the room
