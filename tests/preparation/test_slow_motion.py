"""Link loss in take-off, on the way to the start and in landing: harmless as shipped, refused with a hint where not."""

from dataclasses import replace
from pathlib import Path

import pytest

from cfplan.errors import NotCertifiedError
from cfplan.preparation.prepare_flight import prepare_flight, prepare_mission
from cfplan.preparation.slow_motion import require_harmless_slow_motion
from cfplan.preparation.steps import StepState
from cfplan.safety.limits_file import load_limits

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def line():
    return prepare_mission(REPOSITORY / "flights" / "line.yaml", load_limits(REPOSITORY / "safety.yaml"))


def under(mission, *, ground=None, space=None, firmware=None, link_loss=None):
    limits = mission.limits
    return replace(
        mission,
        limits=replace(
            limits,
            ground=replace(limits.ground, **ground or {}),
            space=replace(limits.space, **space or {}),
            firmware=replace(limits.firmware, **firmware or {}),
            link_loss=replace(limits.link_loss, **link_loss or {}),
        ),
    )


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.stem, marks=[] if path.stem in ("line", "loop3d") else pytest.mark.slow)
        for path in sorted((REPOSITORY / "flights").glob("*.yaml"))
    ],
)
def test_every_shipped_path_may_be_begun_and_ended(path, line):
    mission = prepare_mission(path, line.limits)
    said = []
    require_harmless_slow_motion(mission, lambda name, state, result: said.append((state, result)))
    state, result = said[-1]
    assert state is StepState.FINISHED
    assert "m inside the wall" in result


def test_a_flight_is_prepared_with_it():
    steps = []
    prepare_flight(
        REPOSITORY / "flights" / "line.yaml",
        load_limits(REPOSITORY / "safety.yaml"),
        on_step=lambda name, state, _: steps.append((name, state)),
    )
    assert ("slow phases", StepState.FINISHED) in steps


FAST = {"go_to_speed": 2.0}


def test_a_hasty_way_to_the_start_is_refused(line):
    with pytest.raises(NotCertifiedError, match=r"on the way from \(.*\) m to the start .* beyond the wall") as caught:
        require_harmless_slow_motion(under(line, ground=FAST))
    assert "go_to_speed" in caught.value.hint
    assert caught.value.where == "link loss"


def test_without_the_watchdog_it_is_as_harmless(line):
    require_harmless_slow_motion(under(line, firmware={"watchdog": False}))


@pytest.mark.parametrize("margin", [0.0, 0.03])
def test_a_take_off_beside_a_wall_is_refused(line, margin):
    with pytest.raises(NotCertifiedError, match=r"in take-off at \(.*\) m .* beyond the wall") as caught:
        require_harmless_slow_motion(under(line, space={"margin": margin}))
    assert "space.margin" in caught.value.hint


def test_a_landing_beside_a_wall_is_refused(line):
    y = line.end[0][1]
    space = line.limits.space
    near = (space.low[0], space.low[1], space.low[2]), (space.high[0], y + 0.02, space.high[2])
    with pytest.raises(NotCertifiedError, match="beyond the wall y"):
        require_harmless_slow_motion(under(line, space={"low": near[0], "high": near[1]}))


def test_a_room_with_nets_is_warned(line):
    said = []
    nets = under(line, ground=FAST, link_loss={"only_warn": True})
    require_harmless_slow_motion(nets, lambda name, state, result: said.append((state, result)))
    assert said[-1][0] is StepState.WARNED
    assert "beyond the wall" in said[-1][1]
