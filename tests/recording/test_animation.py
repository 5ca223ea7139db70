"""A record as a GIF: as many frames as the flight along the path lasts, which move, in a file for a page."""

import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageChops

from cfplan.cli import cfplan as command
from cfplan.errors import InputError
from cfplan.geometry.min_snap import min_snap
from cfplan.planning.plan import plan
from cfplan.planning.plan_file import save_plan
from cfplan.recording.animation import HEIGHT, RATE, WIDTH, animate_flight, check_animation_file
from cfplan.recording.reader import read_record
from cfplan.recording.summary import reference_span
from cfplan.safety.limits_file import load_limits

REPOSITORY = Path(__file__).parents[2]
LARGEST = 2_000_000  # bytes, of a picture on a page


@pytest.fixture(scope="module")
def planned(flight, tmp_path_factory):
    """A record with a plan beside it."""
    limits = load_limits(REPOSITORY / "safety.yaml")
    place = shutil.copytree(flight.folder, tmp_path_factory.mktemp("planned") / "flown")
    made = plan(min_snap([[-1, -1, 0.8], [1, -0.5, 0.9]]), limits.airframe, limits, planner="minsnap", nodes=40)
    save_plan(made, place / "plan.parquet")
    return read_record(place)


@pytest.fixture(scope="module")
def animation(planned, tmp_path_factory):
    """The GIF of a flight, as the command writes it."""
    file = tmp_path_factory.mktemp("animation") / "flight.gif"
    command.main(["replay", str(planned.folder), "--gif", str(file)], standalone_mode=False)
    return file


def test_it_lasts_as_long_as_the_flight_and_repeats(planned, animation):
    begin, end = reference_span(planned)
    with Image.open(animation) as image:
        assert image.size == (WIDTH, HEIGHT)
        lasts = 0
        for number in range(image.n_frames):
            image.seek(number)
            lasts += image.info["duration"]
        assert lasts / 1000 == pytest.approx(end - begin + 1.5, abs=0.6)
        assert image.info["loop"] == 0
    assert animation.stat().st_size < LARGEST


def test_the_vehicle_moves_from_frame_to_frame(planned):
    frames = animate_flight(planned)
    changed = [ImageChops.difference(a, b).getbbox() is not None for a, b in pairwise(frames)]
    assert np.mean(changed) > 0.9
    assert len(frames) > RATE


def test_what_cannot_be_written_is_refused_first(flight, tmp_path):
    for name, words in (("flight.mp4", "must end in"), ("nowhere/flight.gif", "no such folder")):
        with pytest.raises(InputError, match=words):
            check_animation_file(tmp_path / name, overwrite=False)
    (tmp_path / "flight.gif").write_bytes(b"")
    with pytest.raises(InputError, match="already"):
        check_animation_file(tmp_path / "flight.gif", overwrite=False)
    with pytest.raises(InputError, match="of one record"):
        command.main(
            ["replay", str(flight.folder), str(flight.folder), "--gif", str(tmp_path / "two.gif")],
            standalone_mode=False,
        )


def test_the_readmes_animation_is_small_enough_for_a_first_screen():
    assert 0 < (REPOSITORY / "docs" / "images" / "flight.gif").stat().st_size < LARGEST
