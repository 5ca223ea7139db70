"""Evaluate the networks without torch: one thread, compiled loops over weights laid out for them.

Matrix products are compiled loops: numpy would distribute them over threads, which wait for one another if the
processor's other cores are busy.
"""

from collections.abc import Mapping
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cfplan.learning.features import INPUTS, OUTPUTS
from cfplan.machine_code import njit

# tanh as a rational function of degree 13 over 6 (the minimax fit that Eigen uses), within 2e-7 where it is not ±1.
_REACH = np.float32(7.90531)
_A1, _A3, _A5, _A7, _A9, _A11, _A13 = np.array(
    [4.89352455891786e-03, 6.37261928875436e-04, 1.48572235717979e-05, 5.12229709037114e-08, -8.60467152213735e-11,
     2.00018790482477e-13, -2.76076847742355e-16], dtype=np.float32,
)  # fmt: skip
_B0, _B2, _B4, _B6 = np.array(
    [4.89352518554385e-03, 2.26843463243900e-03, 1.18534705686654e-04, 1.19825839466702e-06], dtype=np.float32
)
_HALF = np.float32(0.5)


class Network(Protocol):
    """A network ready to answer."""

    def __call__(self, inputs: NDArray) -> NDArray:
        """Map B windows at once, (B, W+1, INPUTS) float32, to (B, W+1, OUTPUTS) float32."""


class Layer:
    """An LSTM layer in one or both directions."""

    def __init__(self, weights: Mapping[str, NDArray], prefix: str, number: int, directions: int) -> None:
        endings = [f"_l{number}" + ("_reverse" if reverse else "") for reverse in range(directions)]
        bias = [weights[f"{prefix}bias_ih{end}"] + weights[f"{prefix}bias_hh{end}"] for end in endings]
        self.inward = np.ascontiguousarray(np.concatenate([weights[f"{prefix}weight_ih{end}"] for end in endings]).T)
        self.bias = np.concatenate(bias)
        # (directions, H, 4H): a row is what one hidden unit adds to all gates
        self.recurrent = np.ascontiguousarray(
            np.stack([weights[f"{prefix}weight_hh{end}"] for end in endings]).transpose(0, 2, 1)
        )

    def __call__(self, inputs: NDArray) -> tuple[NDArray, NDArray, NDArray]:
        """Map (B, T, I) to (B, T, directions · H); return also the last hidden and cell states, (directions, B, H)."""
        directions, hidden = self.recurrent.shape[:2]
        batch, steps = inputs.shape[:2]
        out = np.empty((batch, steps, directions * hidden), np.float32)
        h, c = np.zeros((2, directions, batch, hidden), np.float32)
        projected = np.empty((batch * steps, len(self.bias)), np.float32)
        _project(projected, np.ascontiguousarray(inputs).reshape(batch * steps, -1), self.inward, self.bias)
        _run(out, projected.reshape(batch, steps, -1), self.recurrent, h, c)
        return out, h, c


class CompiledBiLstm:
    """See networks.BiLstm."""

    def __init__(self, weights: Mapping[str, NDArray]) -> None:
        self.layers = [Layer(weights, "lstm.", number, 2) for number in range(_layers(weights, "lstm."))]
        _normalise(self.layers[0], weights)
        self.head, self.bias = np.ascontiguousarray(weights["head.weight"].T), weights["head.bias"]

    def __call__(self, inputs: NDArray) -> NDArray:
        """See Network."""
        values = inputs
        for layer in self.layers:
            values, _, _ = layer(values)
        out = np.empty((*values.shape[:2], len(self.bias)), np.float32)
        _project(out.reshape(-1, len(self.bias)), values.reshape(-1, values.shape[2]), self.head, self.bias)
        return out


class CompiledEncoderDecoder:
    """See networks.EncoderDecoder."""

    def __init__(self, weights: Mapping[str, NDArray]) -> None:
        count = _layers(weights, "encoder.")
        self.encoder = [Layer(weights, "encoder.", number, 1) for number in range(count)]
        self.decoder = [Layer(weights, "decoder.", number, 1) for number in range(count)]
        _normalise(self.encoder[0], weights)
        self.head, self.bias = np.ascontiguousarray(weights["head.weight"].T), weights["head.bias"]

    def __call__(self, inputs: NDArray) -> NDArray:
        """See Network."""
        memory = inputs
        states = []
        for layer in self.encoder:
            memory, h, c = layer(memory)
            states.append((h, c))
        batch, steps, hidden = memory.shape
        answer = np.zeros((batch, 1, len(self.bias)), np.float32)
        out = np.empty((batch, steps, len(self.bias)), np.float32)
        step = np.empty((batch, 1, hidden), np.float32)
        for n in range(steps):
            values = answer
            for layer, (h, c) in zip(self.decoder, states, strict=True):
                _run(step, values @ layer.inward + layer.bias, layer.recurrent, h, c)
                values = step.copy()
            weights = memory @ (values * np.float32(hidden**-0.5)).transpose(0, 2, 1)  # (B, T, 1)
            weights = np.exp(weights - weights.max(axis=1, keepdims=True))
            context = (weights / weights.sum(axis=1, keepdims=True)).transpose(0, 2, 1) @ memory
            answer = np.concatenate([values, context], axis=2) @ self.head + self.bias
            out[:, n] = answer[:, 0]
        return out


NETWORKS: Mapping[str, type[CompiledBiLstm] | type[CompiledEncoderDecoder]] = {
    "bilstm": CompiledBiLstm,
    "attention": CompiledEncoderDecoder,
}


def _layers(weights: Mapping[str, NDArray], prefix: str) -> int:
    return sum(1 for name in weights if name.startswith(f"{prefix}weight_hh_l") and not name.endswith("_reverse"))


def _normalise(layer: Layer, weights: Mapping[str, NDArray]) -> None:
    """Fold the normalisation of the inputs into the layer's weights."""
    inward = layer.inward.astype(float) * weights["scale"].astype(float)[:, None]
    layer.bias = (layer.bias - weights["mean"].astype(float) @ inward).astype(np.float32)
    layer.inward = inward.astype(np.float32)


@njit(fastmath=True, error_model="numpy")
def _tanh(x: np.float32) -> np.float32:
    x = max(min(x, _REACH), -_REACH)
    y = x * x
    above = x * (_A1 + y * (_A3 + y * (_A5 + y * (_A7 + y * (_A9 + y * (_A11 + y * _A13))))))
    return above / (_B0 + y * (_B2 + y * (_B4 + y * _B6)))


@njit(fastmath=True, error_model="numpy")
def _add_product(sums: NDArray, values: NDArray, weights: NDArray) -> None:
    """Add values, (I,), @ weights, (I, K), to the sums, (K,): eight rows of the weights at once."""
    whole = len(values) - len(values) % 8
    for j in range(0, whole, 8):
        for k in range(len(sums)):
            total = sums[k]
            for i in range(8):
                total += values[j + i] * weights[j + i, k]
            sums[k] = total
    for j in range(whole, len(values)):
        for k in range(len(sums)):
            sums[k] += values[j] * weights[j, k]


@njit(fastmath=True, error_model="numpy")
def _project(out: NDArray, inputs: NDArray, weights: NDArray, bias: NDArray) -> None:
    """Write inputs, (R, I), @ weights, (I, K), + bias, (K,), to `out`."""
    for row in range(len(inputs)):
        for k in range(len(bias)):
            out[row, k] = bias[k]
        _add_product(out[row], inputs[row], weights)


@njit(fastmath=True, error_model="numpy")
def _run(out: NDArray, projected: NDArray, recurrent: NDArray, last: NDArray, cell: NDArray) -> None:
    """Run an LSTM layer over all steps; gates in torch's order: input, forget, cell, output."""
    batch, steps, hidden = out.shape[0], out.shape[1], last.shape[2]
    gates = np.empty(4 * hidden, np.float32)
    for direction in range(recurrent.shape[0]):
        weights = recurrent[direction]
        column = direction * hidden
        for b in range(batch):
            h, c = last[direction, b], cell[direction, b]
            for n in range(steps):
                t = n if direction == 0 else steps - 1 - n
                for k in range(4 * hidden):
                    gates[k] = projected[b, t, 4 * column + k]
                _add_product(gates, h, weights)
                for k in range(hidden):
                    let_in = _HALF + _HALF * _tanh(_HALF * gates[k])
                    keep = _HALF + _HALF * _tanh(_HALF * gates[hidden + k])
                    value = keep * c[k] + let_in * _tanh(gates[2 * hidden + k])
                    c[k] = value
                    h[k] = (_HALF + _HALF * _tanh(_HALF * gates[3 * hidden + k])) * _tanh(value)
                for k in range(hidden):
                    out[b, t, column + k] = h[k]


def tensor_shapes(architecture: str, hidden: int, layers: int) -> dict[str, tuple[int, ...]]:
    """Return the shapes of a network's tensors, by the names that torch gives them."""
    parts: dict[str, list[tuple[str, int, tuple[str, ...]]]] = {
        "bilstm": [("lstm.", INPUTS, ("", "_reverse"))],
        "attention": [("encoder.", INPUTS, ("",)), ("decoder.", OUTPUTS, ("",))],
    }
    if architecture not in parts:
        return {}
    found: dict[str, tuple[int, ...]] = {
        "mean": (INPUTS,), "scale": (INPUTS,), "head.weight": (OUTPUTS, 2 * hidden), "head.bias": (OUTPUTS,),
    }  # fmt: skip
    for prefix, inputs, directions in parts[architecture]:
        for layer in range(layers):
            into = inputs if layer == 0 else len(directions) * hidden
            for direction in directions:
                end = f"_l{layer}{direction}"
                found[f"{prefix}weight_ih{end}"] = (4 * hidden, into)
                found[f"{prefix}weight_hh{end}"] = (4 * hidden, hidden)
                found[f"{prefix}bias_ih{end}"] = found[f"{prefix}bias_hh{end}"] = (4 * hidden,)
    return found
