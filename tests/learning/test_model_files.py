"""Model folders: what does not fit is named, and never flown on."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cfplan.errors import InputError
from cfplan.learning.features import INPUTS
from cfplan.learning.inference import NETWORKS
from cfplan.learning.model_files import (
    CARD,
    WEIGHTS,
    Model,
    find_model,
    load_card,
    load_model,
    models_folder,
    save_model,
)
from cfplan.safety.limit_sets import LIMIT_SETS

HARDWARE, SIMULATION = LIMIT_SETS["hardware"], LIMIT_SETS["simulation"]


def edit(folder, **changes):
    content = json.loads((folder / CARD).read_text())
    (folder / CARD).write_text(json.dumps(content | changes))


def refusal(folder, airframe=None) -> InputError:
    with pytest.raises(InputError) as error:
        load_model(folder, airframe)
    assert error.value.where
    assert error.value.hint
    assert "\n" not in str(error.value)
    return error.value


def test_what_was_saved_is_loaded(saved, make_card, make_weights):
    model = load_model(saved, HARDWARE.airframe)
    assert replace(model.card, weights_sha256="") == make_card()
    inputs = np.random.default_rng(0).normal(size=(25, INPUTS)).astype(np.float32)
    np.testing.assert_array_equal(model.network(inputs), NETWORKS["bilstm"](make_weights())(inputs))


def test_unlimited_angular_acceleration_survives_the_card(tmp_path, make_card, make_weights):
    free = replace(SIMULATION.limits, angular_acceleration=math.inf)
    save_model(tmp_path, make_card(airframe=SIMULATION.airframe, limits=free), make_weights())
    assert load_card(tmp_path).limits.angular_acceleration == math.inf


def test_missing_files_are_named(tmp_path, saved):
    assert CARD in refusal(tmp_path).what
    (saved / WEIGHTS).unlink()
    assert refusal(saved).where.endswith(WEIGHTS)


@pytest.mark.parametrize("at", [0, 100, -1])
def test_damaged_weights_are_refused(saved, at):
    content = bytearray((saved / WEIGHTS).read_bytes())
    content[at] ^= 1
    (saved / WEIGHTS).write_bytes(content)
    assert "hashes differ" in refusal(saved).what


def test_weights_of_another_model_are_refused(saved, tmp_path, make_card, make_weights):
    save_model(tmp_path / "other", make_card(), make_weights(seed=1))
    (saved / WEIGHTS).write_bytes((tmp_path / "other" / WEIGHTS).read_bytes())
    assert "hashes differ" in refusal(saved).what


def test_a_card_of_another_network_is_refused(tmp_path, make_card, make_weights):
    save_model(tmp_path, make_card(hidden=16), make_weights())
    assert "as the card says" in refusal(tmp_path).what
    save_model(tmp_path, make_card(architecture="attention"), make_weights())
    assert "as the card says" in refusal(tmp_path).what
    save_model(tmp_path, make_card(architecture="oracle"), make_weights())
    assert "as the card says" in refusal(tmp_path).what


def test_weights_that_are_not_numbers_are_refused(tmp_path, make_card, make_weights):
    save_model(tmp_path, make_card(), make_weights() | {"head.bias": np.array([0, np.nan, 0], np.float32)})
    assert "not finite" in refusal(tmp_path).what


def test_a_file_that_is_no_weights_file_is_refused(saved):
    import hashlib

    (saved / WEIGHTS).write_bytes(b"\x80\x04pickle")
    edit(saved, weights_sha256=hashlib.sha256(b"\x80\x04pickle").hexdigest())
    assert "not weights" in refusal(saved).what


def test_cards_of_another_time_ask_for_training(saved):
    edit(saved, features=99)
    assert "cfplan train" in refusal(saved).hint
    edit(saved, format=2)
    assert "format 2" in refusal(saved).what


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=200) | st.recursive(st.none() | st.floats() | st.text(), st.lists).map(json.dumps))
def test_anything_that_is_no_card_is_one_line(saved, content):
    (saved / CARD).write_bytes(content if isinstance(content, bytes) else content.encode(errors="replace"))
    refusal(saved)


@pytest.mark.parametrize(
    "change",
    [{"hidden": "many"}, {"limits": {}}, {"airframe": None}, {"scores": [1]}, {"limits": {"speed": "fast"}}],
)
def test_a_card_with_wrong_contents_is_refused(saved, change):
    edit(saved, **change)
    assert "not a model card" in refusal(saved).what


def test_a_model_for_another_vehicle_is_refused_naming_the_difference(saved):
    heavier = replace(HARDWARE.airframe, mass=0.045)
    error = refusal(saved, heavier)
    assert "another vehicle" in error.what
    assert "mass" in error.what
    load_model(saved, replace(HARDWARE.airframe, name="mine"))


def test_what_differs_in_limits_is_said(model):
    assert model.differences(HARDWARE.limits) == ()
    tighter, looser = model.differences(replace(HARDWARE.limits, speed=1.5, motor_thrust_min=0.0))
    assert "speed is 1.5" in tighter
    assert "repair" in tighter
    assert "the model's own is kept" in looser


def test_limits_are_used_as_far_as_the_model_knows(model):
    asked = replace(HARDWARE.limits, speed=3.0, acceleration=4.0, motor_thrust_min=0.0)
    within = model.limits_within(asked)
    assert within.speed == HARDWARE.limits.speed
    assert within.acceleration == 4.0
    assert within.motor_thrust_min == HARDWARE.limits.motor_thrust_min


def test_a_model_without_a_limit_serves_where_there_is_one_and_the_other_way_round(tmp_path, make_card, make_weights):
    free = replace(HARDWARE.limits, angular_acceleration=math.inf)
    for name, known, asked in (("free", free, HARDWARE.limits), ("bound", HARDWARE.limits, free)):
        save_model(tmp_path / name / "only", make_card(name=name, limits=known), make_weights())
        model = find_model(HARDWARE.airframe, asked, tmp_path / name)
        assert model is not None
        assert model.name == name


def test_the_nearest_model_for_the_vehicle_is_found(tmp_path, make_card, make_weights):
    faster = replace(HARDWARE.limits, speed=3.0)
    for name, limits in (("slow", HARDWARE.limits), ("fast", faster)):
        save_model(tmp_path / name, make_card(name=name, limits=limits), make_weights())

    def found(airframe, limits) -> str | None:
        model = find_model(airframe, limits, tmp_path)
        return model.name if isinstance(model, Model) else None

    assert found(HARDWARE.airframe, HARDWARE.limits) == "slow"
    assert found(HARDWARE.airframe, replace(faster, speed=2.9)) == "fast"
    assert found(HARDWARE.airframe, replace(faster, speed=0.5)) is None
    assert found(SIMULATION.airframe, HARDWARE.limits) is None
    assert find_model(HARDWARE.airframe, HARDWARE.limits, tmp_path / "nothing") is None


def test_models_are_beside_the_package_in_a_checkout():
    assert models_folder().name == "models"


def test_a_full_disk_leaves_the_old_model(saved, monkeypatch, make_card, make_weights):
    from pathlib import Path

    def full(self, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OSError, match="No space"):
        save_model(saved, make_card(), make_weights(seed=3))
    monkeypatch.undo()
    load_model(saved)
