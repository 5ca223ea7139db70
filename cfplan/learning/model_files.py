"""Model folders: weights.safetensors, and card.json with its provenance and what it may be used for.

A card names its weights by their hash, and all that decides whether they may be used: the vehicle, the limits, the
window, and the version of the features. A model that does not fit is an error, never a flight.
"""

import hashlib
import json
import math
import sysconfig
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.learning import features
from cfplan.learning.inference import NETWORKS, Network, tensor_shapes
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import Airframe

WEIGHTS, CARD = "weights.safetensors", "card.json"
FORMAT = 1
LARGEST = 10_000  # layers, hidden numbers of each, and intervals of a window
HEAVIEST = 1e6  # weight; trained ones are a few
TIGHTEST = 0.5  # of a model's limit: for tighter ones repair would do more than the model
_RETRAIN = "train it again with `cfplan train`"
_RESTORE = "restore both files from where the model came, or train it again with `cfplan train`"


@dataclass(frozen=True, slots=True, kw_only=True)
class Card:
    """The provenance of a model, what it is for, and its scores."""

    name: str
    architecture: str  # an Architecture
    hidden: int
    layers: int
    window: int  # intervals
    features: int  # version of features.py
    weights_sha256: str
    airframe: Airframe
    limits: PlanLimits
    data: dict[str, Any]  # the dataset's spec, and how many of its rows were learned from
    training: dict[str, Any]  # the command and its options
    scores: dict[str, float]  # on paths that were not learned from
    date: str
    version: str  # of cfplan
    format: int = FORMAT


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """A network ready to plan, and its card."""

    card: Card
    network: Network

    @property
    def name(self) -> str:
        return self.card.name

    @property
    def window(self) -> int:
        """Return the intervals of a window."""
        return self.card.window

    def limits_within(self, limits: PlanLimits) -> PlanLimits:
        """Return these limits, but the model's own where its own are tighter."""
        both = ((name, getattr(self.card.limits, name), getattr(limits, name)) for name in PlanLimits.__slots__)
        return PlanLimits(**{name: (max if name.endswith("_min") else min)(own, other) for name, own, other in both})

    def differences(self, limits: PlanLimits) -> tuple[str, ...]:
        """Return how these limits differ from those that the model was trained with, a sentence each."""
        sentences = []
        for name, own in asdict(self.card.limits).items():
            wanted = getattr(limits, name)
            if math.isclose(own, wanted, rel_tol=1e-9):
                continue
            tighter = wanted > own if name.endswith("_min") else wanted < own
            meaning = "tighter: repair keeps it" if tighter else "looser: the model's own is kept"
            sentences.append(f"{name} is {wanted:.4g}, the model {self.name} was trained with {own:.4g} ({meaning})")
        return tuple(sentences)


def save_model(folder: Path, card: Card, weights: Mapping[str, NDArray]) -> Card:
    """Write both files, each whole or not at all. Return the card as written, with the hash of the weights."""
    from safetensors.numpy import save

    content = save({name: np.ascontiguousarray(values) for name, values in weights.items()})
    text = asdict(card) | {"weights_sha256": hashlib.sha256(content).hexdigest()}
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in ((WEIGHTS, content), (CARD, (json.dumps(text, indent=2, ensure_ascii=False) + "\n").encode())):
        temporary = folder / f".{name}.new"
        temporary.write_bytes(data)
        temporary.replace(folder / name)
    return _card(text)


def load_card(folder: Path) -> Card:
    """Read the card of a model folder.

    Raises:
        InputError: no card, one that cannot be read, or of another format or version of the features.
    """
    file = folder / CARD
    if not file.is_file():  # a pipe would be waited for
        raise InputError(f"no model: {CARD} is missing", where=str(folder), hint="train one with `cfplan train`")
    try:
        text = json.loads(file.read_bytes())
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"cannot be read: {error}", where=str(file), hint=_RESTORE) from None
    if not isinstance(text, dict) or text.get("format") != FORMAT:
        found = text.get("format") if isinstance(text, dict) else None
        raise InputError(f"a model of format {found}, not {FORMAT}", where=str(file), hint=_RETRAIN)
    try:
        card = _card(text)
    except (ValueError, TypeError, OverflowError, RecursionError) as error:
        raise InputError(
            f"not a model card: {' '.join(str(error).split())[:160]}", where=str(file), hint=_RESTORE
        ) from None
    if card.features != features.VERSION:
        raise InputError(
            f"trained on features of version {card.features}; this cfplan has version {features.VERSION}",
            where=str(file),
            hint=_RETRAIN,
        )
    return card


def load_model(folder: Path, airframe: Airframe | None = None) -> Model:
    """Load a model and check it: the card's hash, and the names, shapes and finiteness of the weights.

    Raises:
        InputError: damaged or foreign weights, a card of others, or a model for another vehicle than `airframe`.
    """
    from safetensors import SafetensorError
    from safetensors.numpy import load

    card = load_card(folder)
    where = str(folder / WEIGHTS)
    if not (folder / WEIGHTS).is_file():
        raise InputError("no such file", where=where, hint=_RESTORE)
    try:
        content = (folder / WEIGHTS).read_bytes()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", where=where, hint=_RESTORE) from None
    if hashlib.sha256(content).hexdigest() != card.weights_sha256:
        raise InputError(
            "damaged, or not the weights that the card is of: their hashes differ", where=where, hint=_RESTORE
        )
    try:
        weights = load(content)
    except (SafetensorError, ValueError, KeyError) as error:
        raise InputError(f"not weights: {error}", where=where, hint=_RESTORE) from None
    expected = tensor_shapes(card.architecture, card.hidden, card.layers)
    if not expected or {name: values.shape for name, values in weights.items()} != expected:
        raise InputError(
            f"not the weights of a {card.architecture} of {card.layers} x {card.hidden}, as the card says",
            where=where,
            hint=_RESTORE,
        )
    if not all(values.dtype == np.float32 and (np.abs(values) < HEAVIEST).all() for values in weights.values()):
        raise InputError(f"some weights are not finite 32-bit numbers below {HEAVIEST:g}", where=where, hint=_RESTORE)
    if airframe is not None and (other := other_vehicle(card, airframe)):
        raise InputError(
            f"a model for another vehicle: {other}",
            where=str(folder),
            hint="train one for this vehicle, or take another planner",
        )
    return Model(card, NETWORKS[card.architecture](weights))


def other_vehicle(card: Card, airframe: Airframe) -> str:
    """Return how an airframe differs from the model's; empty if it is the same."""
    differs = [
        f"{field.name} {getattr(card.airframe, field.name)} there, {getattr(airframe, field.name)} here"
        for field in fields(Airframe)
        if field.name not in ("name", "source") and getattr(card.airframe, field.name) != getattr(airframe, field.name)
    ]
    return f"{card.airframe.name} there, {airframe.name} here: {'; '.join(differs)}" if differs else ""


@lru_cache(maxsize=1)
def models_folder() -> Path:
    """Return the folder of the models that come with cfplan: beside the package in a checkout, else as pip put it."""
    checkout = Path(__file__).parents[2]
    if (checkout / "pyproject.toml").is_file():
        return checkout / "models"
    return Path(sysconfig.get_path("data")) / "share" / "cfplan" / "models"


def find_model(airframe: Airframe, limits: PlanLimits, folder: Path | None = None) -> Model | None:
    """Load the model for this vehicle that is nearest to these limits.

    Searched is a folder, else the models that come with cfplan. None if none is for this vehicle, or if a limit is less
    than half of the model's.

    Raises:
        InputError: a model that fits is damaged.
    """
    return _find(airframe, limits, folder or models_folder())


@lru_cache(maxsize=8)
def _find(airframe: Airframe, limits: PlanLimits, folder: Path) -> Model | None:
    fitting = []
    for file in sorted(folder.glob(f"*/{CARD}")):
        card = load_card(file.parent)
        distance = _distance(card.limits, limits)
        if not other_vehicle(card, airframe) and distance < math.inf:
            fitting.append((distance, file.parent))
    return load_model(min(fitting)[1]) if fitting else None


def _distance(own: PlanLimits, wanted: PlanLimits) -> float:
    """Return how far limits are from a model's; infinite where the model is of no use for them."""
    total = 0.0
    for name in ("speed", "acceleration", "angular_velocity", "angular_acceleration", "tilt", "motor_thrust_max"):
        known, asked = getattr(own, name), getattr(wanted, name)
        if known == asked:
            continue
        if asked < TIGHTEST * known and known < math.inf:
            return math.inf
        total += min(abs(math.log(asked / known)), 1.0) if known < math.inf else 1.0
    return total


def _card(text: Mapping[str, Any]) -> Card:
    """Return the card. Raises ValueError where a number is not one that a model can have."""
    from pydantic import TypeAdapter

    card = TypeAdapter(Card).validate_python(text)
    sizes = {"hidden": card.hidden, "layers": card.layers, "window": card.window}
    figures = asdict(card.airframe) | asdict(card.limits)
    for name, value in (sizes | figures).items():
        for number in value if isinstance(value, tuple) else (value,):
            if not isinstance(number, str) and not number >= (1 if name in sizes else 0):
                raise ValueError(f"{name} is {number}")
            if name in sizes and number > LARGEST:
                raise ValueError(f"{name} is {number}, more than {LARGEST}")
    if not all(value > 0 for name, value in asdict(card.limits).items() if not name.endswith("_min")):
        raise ValueError("a limit is 0")
    return card
