"""Evaluate the networks without torch: one thread, compiled loops over weights laid out for them.

The input projections of a layer do not depend on the step before and are one matrix product, in a loop of our own:
numpy would hand it to threads, which wait for one another where the processor's other cores are busy. The recurrence
is a loop over the steps in which eight rows of the recurrent weights are added up at once.
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
def _add_recurrent(gates: NDArray, projected: NDArray, h: NDArray, weights: NDArray) -> None:
    """Write projected + h @ weights to the gates, (4H,): eight rows of the weights, (H, 4H), at once."""
    hidden = len(h)
    for k in range(4 * hidden):
        gates[k] = projected[k]
    whole = hidden - hidden % 8
    for j in range(0, whole, 8):
        h0, h1, h2, h3, h4, h5, h6, h7 = h[j], h[j + 1], h[j + 2], h[j + 3], h[j + 4], h[j + 5], h[j + 6], h[j + 7]
        w0, w1, w2, w3 = weights[j], weights[j + 1], weights[j + 2], weights[j + 3]
        w4, w5, w6, w7 = weights[j + 4], weights[j + 5], weights[j + 6], weights[j + 7]
        for k in range(4 * hidden):
            gates[k] += (h0 * w0[k] + h1 * w1[k] + h2 * w2[k] + h3 * w3[k]) + (
                h4 * w4[k] + h5 * w5[k] + h6 * w6[k] + h7 * w7[k]
            )
    for j in range(whole, hidden):
        for k in range(4 * hidden):
            gates[k] += h[j] * weights[j, k]


def _project_interpreted(out: NDArray, inputs: NDArray, weights: NDArray, bias: NDArray) -> None:
    out[:] = inputs @ weights + bias


@njit(interpreted=_project_interpreted, fastmath=True, error_model="numpy")
def _project(out: NDArray, inputs: NDArray, weights: NDArray, bias: NDArray) -> None:
    """Write inputs, (R, I), @ weights, (I, K), + bias, (K,), to `out`: eight rows by four at once."""
    rows, width, whole = len(inputs), len(bias), inputs.shape[1] - inputs.shape[1] % 4
    sums = np.empty((8, width), np.float32)
    s0, s1, s2, s3, s4, s5, s6, s7 = sums[0], sums[1], sums[2], sums[3], sums[4], sums[5], sums[6], sums[7]
    for begin in range(0, rows, 8):
        last = rows - 1  # again and again where there are no eight
        a, b = inputs[begin], inputs[min(begin + 1, last)]
        c, d = inputs[min(begin + 2, last)], inputs[min(begin + 3, last)]
        e, f = inputs[min(begin + 4, last)], inputs[min(begin + 5, last)]
        g, h = inputs[min(begin + 6, last)], inputs[min(begin + 7, last)]
        for k in range(width):
            s0[k] = s1[k] = s2[k] = s3[k] = s4[k] = s5[k] = s6[k] = s7[k] = bias[k]
        for j in range(0, whole, 4):
            w0, w1, w2, w3 = weights[j], weights[j + 1], weights[j + 2], weights[j + 3]
            a0, a1, a2, a3 = a[j], a[j + 1], a[j + 2], a[j + 3]
            b0, b1, b2, b3 = b[j], b[j + 1], b[j + 2], b[j + 3]
            c0, c1, c2, c3 = c[j], c[j + 1], c[j + 2], c[j + 3]
            d0, d1, d2, d3 = d[j], d[j + 1], d[j + 2], d[j + 3]
            e0, e1, e2, e3 = e[j], e[j + 1], e[j + 2], e[j + 3]
            f0, f1, f2, f3 = f[j], f[j + 1], f[j + 2], f[j + 3]
            g0, g1, g2, g3 = g[j], g[j + 1], g[j + 2], g[j + 3]
            h0, h1, h2, h3 = h[j], h[j + 1], h[j + 2], h[j + 3]
            for k in range(width):
                v0, v1, v2, v3 = w0[k], w1[k], w2[k], w3[k]
                s0[k] += (a0 * v0 + a1 * v1) + (a2 * v2 + a3 * v3)
                s1[k] += (b0 * v0 + b1 * v1) + (b2 * v2 + b3 * v3)
                s2[k] += (c0 * v0 + c1 * v1) + (c2 * v2 + c3 * v3)
                s3[k] += (d0 * v0 + d1 * v1) + (d2 * v2 + d3 * v3)
                s4[k] += (e0 * v0 + e1 * v1) + (e2 * v2 + e3 * v3)
                s5[k] += (f0 * v0 + f1 * v1) + (f2 * v2 + f3 * v3)
                s6[k] += (g0 * v0 + g1 * v1) + (g2 * v2 + g3 * v3)
                s7[k] += (h0 * v0 + h1 * v1) + (h2 * v2 + h3 * v3)
        for j in range(whole, inputs.shape[1]):
            for k in range(width):
                v0 = weights[j, k]
                s0[k] += a[j] * v0
                s1[k] += b[j] * v0
                s2[k] += c[j] * v0
                s3[k] += d[j] * v0
                s4[k] += e[j] * v0
                s5[k] += f[j] * v0
                s6[k] += g[j] * v0
                s7[k] += h[j] * v0
        for row in range(min(8, rows - begin)):
            for k in range(width):
                out[begin + row, k] = sums[row, k]


def _run_interpreted(out: NDArray, projected: NDArray, recurrent: NDArray, last: NDArray, cell: NDArray) -> None:
    steps, hidden = out.shape[1], last.shape[2]
    for direction, weights in enumerate(recurrent):
        h, c, column = last[direction], cell[direction], direction * hidden
        for t in range(steps) if direction == 0 else range(steps - 1, -1, -1):
            gates = projected[:, t, 4 * column : 4 * (column + hidden)] + h @ weights
            let_in, keep, _, let_out = (_HALF + _HALF * np.tanh(_HALF * gates)).reshape(-1, 4, hidden).swapaxes(0, 1)
            c[:] = keep * c + let_in * np.tanh(gates[:, 2 * hidden : 3 * hidden])
            h[:] = let_out * np.tanh(c)
            out[:, t, column : column + hidden] = h


@njit(interpreted=_run_interpreted, fastmath=True, error_model="numpy")
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
                _add_recurrent(gates, projected[b, t, 4 * column : 4 * (column + hidden)], h, weights)
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
