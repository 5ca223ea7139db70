"""Model folders: what does not fit is named, and never flown on."""

import json
import math
import re
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cfplan.errors import InputError
from cfplan.learning import model_files
from cfplan.learning.features import INPUTS, NUMBERS, scaled_limits
from cfplan.learning.inference import NETWORKS
from cfplan.learning.model_files import (
    CARD,
    WEIGHTS,
    Model,
    find_model,
    load_model,
    models_folder,
    save_model,
)
from cfplan.safety.limit_sets import LIMIT_SETS
from tests.learning.conftest import RANGES

HARDWARE = LIMIT_SETS["hardware"]


def edit(folder, **changes):
    content = json.loads((folder / CARD).read_text())
    (folder / CARD).write_text(json.dumps(content | changes))


def refusal(folder) -> InputError:
    with pytest.raises(InputError) as error:
        load_model(folder)
    assert error.value.where
    assert error.value.hint
    assert "\n" not in str(error.value)
    return error.value


def test_what_was_saved_is_loaded(saved, make_card, make_weights):
    model = load_model(saved)
    assert replace(model.card, weights_sha256="") == make_card()
    inputs = np.random.default_rng(0).normal(size=(2, 25, INPUTS)).astype(np.float32)
    np.testing.assert_array_equal(model.network(inputs), NETWORKS["bilstm"](make_weights())(inputs))


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
    edit(saved, format=1)
    assert "format 1" in refusal(saved).what


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.binary(max_size=200) | st.recursive(st.none() | st.floats() | st.text(), st.lists).map(json.dumps))
def test_anything_that_is_no_card_is_one_line(saved, content):
    (saved / CARD).write_bytes(content if isinstance(content, bytes) else content.encode(errors="replace"))
    refusal(saved)


@pytest.mark.parametrize(
    "change",
    [
        {"hidden": "many"},
        {"hidden": 0},
        {"window": 10**6},
        {"scores": [1]},
        {"ranges": {}},
        {"ranges": {"acceleration": [0, 1]}},
        {"ranges": dict.fromkeys(NUMBERS, (2, 1))},
        {"ranges": dict.fromkeys(NUMBERS, (0, math.nan))},
        {"ranges": dict.fromkeys(NUMBERS, (-8192, 1))},
        {"ranges": dict.fromkeys(NUMBERS, ("low", "high"))},
    ],
)
def test_a_card_with_wrong_contents_is_refused(saved, change):
    edit(saved, **change)
    assert "not a model card" in refusal(saved).what


def test_what_lies_outside_of_what_was_learned_from_is_said_in_one_sentence_each(model):
    assert model.outside(HARDWARE.airframe, HARDWARE.limits) == ()
    heavier = replace(HARDWARE.airframe, mass=0.033)
    assert model.outside(heavier, HARDWARE.limits) == ()
    (said,) = model.outside(HARDWARE.airframe, replace(HARDWARE.limits, tilt=1.6))
    assert "tilt is 1.6" in said
    assert "fallow" in said
    (said,) = model.outside(HARDWARE.airframe, replace(HARDWARE.limits, acceleration=20.0))
    assert re.search(r"acceleration is 2\.04 .* 0\.188 to 1\.39", said)


def test_the_model_that_knows_limits_and_vehicle_is_found(tmp_path, monkeypatch, make_card, make_weights):
    """The narrowest of those that know them, the nearest where none does; a folder given first comes first."""
    wide = {name: (low - 1.0, high + 1.0) for name, (low, high) in RANGES.items()}
    faster = replace(HARDWARE.limits, speed=8.0)
    numbers = scaled_limits(HARDWARE.airframe, faster).numbers
    fast = {name: (float(here) - 1.0, float(here) + 1.0) for name, here in zip(NUMBERS, numbers, strict=True)}
    for name, ranges in (("narrow", RANGES), ("wide", wide), ("fast", fast)):
        save_model(tmp_path / "some" / name, make_card(name=name, ranges=ranges), make_weights())
    save_model(tmp_path / "own" / "mine", make_card(name="mine", ranges=wide), make_weights())

    monkeypatch.setattr(model_files, "models_folder", lambda: tmp_path / "none that come with cfplan")

    def found(limits, *folders) -> str | None:
        model = find_model(HARDWARE.airframe, limits, tuple(tmp_path / folder for folder in folders))
        return model.name if isinstance(model, Model) else None

    assert found(HARDWARE.limits, "some") == "narrow"
    assert found(faster, "some") == "fast"
    assert found(replace(HARDWARE.limits, speed=20.0), "some") == "fast"
    assert found(HARDWARE.limits, "own", "some") == "mine"
    assert found(HARDWARE.limits, "some/wide") == "wide"
    with pytest.raises(InputError, match="no model there"):
        found(HARDWARE.limits, "nothing")


@pytest.mark.parametrize("where", ["mine", "."])
def test_a_model_that_is_trained_again_is_the_one_that_is_found_next(tmp_path, make_card, make_weights, where):
    def found() -> Model:
        model = find_model(HARDWARE.airframe, HARDWARE.limits, (tmp_path / where,))
        assert isinstance(model, Model)
        return model

    save_model(tmp_path / "mine", make_card(name="first"), make_weights())
    first = found()
    assert first.name == "first"
    assert found() is first
    save_model(tmp_path / "mine", make_card(name="again"), make_weights(seed=1))
    assert found().name == "again"


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
