"""Model folders: weights.safetensors, and card.json with its provenance and what it may be used for.

A card holds the hash of its weights and all that decides whether they may be used: the window, the version of the
features, and the ranges of limits and vehicles in training. Outside of these a model may propose poorly, and the plan
reports so; every flight is certified either way.
"""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cfplan.errors import InputError
from cfplan.files.atomic import atomic_write
from cfplan.files.shipped import shipped_folder
from cfplan.learning import features
from cfplan.learning.features import LOGARITHMS, NUMBERS, ScaledLimits, scaled_limits
from cfplan.learning.inference import NETWORKS, Network, tensor_shapes
from cfplan.safety.limits import PlanLimits
from cfplan.vehicle.airframe import Airframe

WEIGHTS, CARD = "weights.safetensors", "card.json"
FORMAT = 2
MAX_SIZE = 10_000  # layers, hidden numbers of each, and intervals of a window
MAX_WEIGHT = 1e6  # trained ones are a few
MAX_RANGE_END = 100.0  # either end of a range; most are logarithms
MAX_DISTANCE = 4.0  # from a range, in its own widths, beyond which models count as equally bad
_RETRAIN = "train it again with `cfplan train`"
_RESTORE = "restore both files from where the model came, or train it again with `cfplan train`"


@dataclass(frozen=True, slots=True, kw_only=True)
class Card:
    """The provenance of a model, its purpose, and its scores."""

    name: str
    architecture: str  # an Architecture
    hidden: int
    layers: int
    window: int  # intervals
    features: int  # version of features.py
    weights_sha256: str
    ranges: dict[str, tuple[float, float]]  # of features.NUMBERS in training
    data: dict[str, Any]  # the dataset's spec, and the number of its rows used in training
    training: dict[str, Any]  # the command and its options
    scores: dict[str, float]  # on paths held out from training
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

    def outside(self, airframe: Airframe, limits: PlanLimits) -> tuple[str, ...]:
        """Return a sentence for each number of vehicle and limits that lies outside of the model's training range."""
        known = scaled_limits(airframe, limits)
        sentences = []
        for k, (name, (low, high)) in enumerate(self.card.ranges.items()):
            here = float(known.numbers[k])
            if low <= here <= high:
                continue
            shown = [math.exp(value) if k < LOGARITHMS else value for value in (here, low, high)]
            sentences.append(
                f"{name} is {shown[0]:.3g} in units of v²/g and v/g, the model {self.name} has learned from "
                f"{shown[1]:.3g} to {shown[2]:.3g}: its proposal may be poor"
            )
        return tuple(sentences)


def save_model(folder: Path, card: Card, weights: Mapping[str, NDArray]) -> Card:
    """Write both files atomically. Return the card as written, with the hash of the weights."""
    from safetensors.numpy import save

    content = save({name: np.ascontiguousarray(values) for name, values in weights.items()})
    text = asdict(card) | {"weights_sha256": hashlib.sha256(content).hexdigest()}
    folder.mkdir(parents=True, exist_ok=True)
    for name, data in ((WEIGHTS, content), (CARD, (json.dumps(text, indent=2, ensure_ascii=False) + "\n").encode())):
        with atomic_write(folder / name) as unfinished:
            unfinished.write_bytes(data)
    return _card(text)


def load_card(folder: Path) -> Card:
    """Read the card of a model folder.

    Raises:
        InputError: no card, one that cannot be read, or of another format or version of the features.
    """
    file = folder / CARD
    if not file.is_file():  # opening a pipe would block
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


def load_model(folder: Path) -> Model:
    """Load a model. Raises what load_weights() raises."""
    card, weights = load_weights(folder)
    return Model(card, NETWORKS[card.architecture](weights))


def load_weights(folder: Path) -> tuple[Card, dict[str, NDArray]]:
    """Load a model's weights and check them: the card's hash, and the names, shapes and finiteness of the weights.

    Raises:
        InputError: damaged or foreign weights, or a card of others.
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
        weights: dict[str, NDArray] = load(content)
    except (SafetensorError, ValueError, KeyError) as error:
        raise InputError(f"not weights: {error}", where=where, hint=_RESTORE) from None
    expected = tensor_shapes(card.architecture, card.hidden, card.layers)
    if not expected or {name: values.shape for name, values in weights.items()} != expected:
        raise InputError(
            f"not the weights of a {card.architecture} of {card.layers} x {card.hidden}, as the card says",
            where=where,
            hint=_RESTORE,
        )
    if not all(values.dtype == np.float32 and (np.abs(values) < MAX_WEIGHT).all() for values in weights.values()):
        raise InputError(f"some weights are not finite 32-bit numbers below {MAX_WEIGHT:g}", where=where, hint=_RESTORE)
    return card, weights


@cache
def models_folder() -> Path:
    """Return the folder of the models that come with cfplan."""
    return shipped_folder() / "models"


def find_model(airframe: Airframe, limits: PlanLimits, folders: tuple[Path, ...] = ()) -> Model | None:
    """Load the model whose training ranges suit this vehicle and these limits best.

    `folders` are searched before the models of cfplan; each holds models, or is itself a model, which is then taken.
    Taken is a model whose ranges contain vehicle and limits, from the first folder with one, and there the one with the
    narrowest ranges; if there is none, the nearest model. None if there is no model at all.

    Raises:
        InputError: a model there is damaged, or a folder holds none.
    """
    searched = (*folders, models_folder())
    return _find(airframe, limits, searched, tuple(map(_card_versions, searched)))


def _card_versions(folder: Path) -> tuple[tuple[str, int, int, int], ...]:
    """Return name, inode, time and size of each card in a folder and its subfolders: a new card differs in them."""
    files = [file for file in (folder / CARD, *folder.glob(f"*/{CARD}")) if file.is_file()]
    return tuple(sorted((str(file), (at := file.stat()).st_ino, at.st_mtime_ns, at.st_size) for file in files))


@lru_cache(maxsize=8)
def _find(airframe: Airframe, limits: PlanLimits, folders: tuple[Path, ...], versions: tuple[Any, ...]) -> Model | None:
    """Find a model as find_model() does; a change of the cards' `versions` reads it again."""
    known, candidates = scaled_limits(airframe, limits), []
    for place, folder in enumerate(folders):
        if (folder / CARD).is_file():
            return load_model(folder)
        files = sorted(folder.glob(f"*/{CARD}"))
        if not files and folder != models_folder():
            raise InputError("no model there", where=str(folder), hint="train one with `cfplan train`")
        for file in files:
            card = load_card(file.parent)
            far = _distance(card, known)
            width = sum(high - low for low, high in card.ranges.values())
            candidates.append((far, place, width, file.parent))
    return load_model(min(candidates)[-1]) if candidates else None


def _distance(card: Card, known: ScaledLimits) -> float:
    """Return the distance of numbers from a model's ranges; 0 within."""
    total = 0.0
    for here, (low, high) in zip(known.numbers, card.ranges.values(), strict=True):
        width = max(high - low, 1e-3)
        total += min(max(low - here, here - high, 0.0) / width, MAX_DISTANCE)
    return total


def _card(text: Mapping[str, Any]) -> Card:
    """Return the card. Raises ValueError if a number is outside of the range that a model can have."""
    from pydantic import TypeAdapter

    card = TypeAdapter(Card).validate_python(text)
    for name, value in {"hidden": card.hidden, "layers": card.layers, "window": card.window}.items():
        if not 1 <= value <= MAX_SIZE:
            raise ValueError(f"{name} is {value}, not from 1 to {MAX_SIZE}")
    if tuple(card.ranges) != NUMBERS:
        raise ValueError(f"ranges are not of {', '.join(NUMBERS)}")
    for name, (low, high) in card.ranges.items():
        if not -MAX_RANGE_END <= low <= high <= MAX_RANGE_END:
            raise ValueError(f"the range of {name} is {low} to {high}")
    return card
