"""A dataset and a model that take no time to make: labels of the plainest planner, weights that say nothing."""

import numpy as np
import pytest

from cfplan.geometry.yaw import YawMode
from cfplan.learning import features, labels
from cfplan.learning.dataset import make_dataset
from cfplan.learning.dataset_spec import DatasetSpec
from cfplan.learning.inference import tensor_shapes
from cfplan.learning.model_files import Card, load_model, save_model
from cfplan.planners.baselines.min_snap import plan_min_snap
from cfplan.safety.limit_sets import LIMIT_SETS

HARDWARE = LIMIT_SETS["hardware"]
TINY = DatasetSpec(
    count=16, seed=5, limits="hardware", families=(), boxes=((4.5, 8.0, 2.0),), waypoints=(3, 4), nodes=40,
    yaw=YawMode.FIXED,
)  # fmt: skip
RANGES = {
    name: (float(here) - 1.0, float(here) + 1.0)
    for name, here in zip(
        features.NUMBERS, features.scaled_limits(HARDWARE.airframe, HARDWARE.limits).numbers, strict=True
    )
}


@pytest.fixture(scope="session")
def tiny(tmp_path_factory):
    """A folder with sixteen labelled paths."""
    folder = tmp_path_factory.mktemp("tiny")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(labels, "plan_expert", plan_min_snap)
        make_dataset(folder, TINY)
    return folder


def card(**changes) -> Card:
    """A card that knows the hardware set, and what is within a factor e of it."""
    known = {
        "name": "fallow", "architecture": "bilstm", "hidden": 8, "layers": 1, "window": 24,
        "features": features.VERSION, "weights_sha256": "", "ranges": RANGES, "data": {}, "training": {},
        "scores": {}, "date": "2026-01-01", "version": "0.1.0",
    }  # fmt: skip
    return Card(**known | changes)


def weights(architecture="bilstm", hidden=8, layers=1, seed=0, size=0.05) -> dict[str, np.ndarray]:
    """Random weights; small ones make a network that answers about the reference."""
    random = np.random.default_rng(seed)
    made = {
        name: random.normal(scale=size, size=shape).astype(np.float32)
        for name, shape in tensor_shapes(architecture, hidden, layers).items()
    }
    return made | {"scale": np.full(features.INPUTS, 0.3, np.float32)}


@pytest.fixture
def make_card():
    return card


@pytest.fixture
def make_weights():
    return weights


@pytest.fixture
def saved(tmp_path):
    """The folder of a model."""
    folder = tmp_path / "fallow"
    save_model(folder, card(), weights())
    return folder


@pytest.fixture
def model(saved):
    return load_model(saved)
