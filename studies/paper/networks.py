"""The networks of the paper's Table 1 in torch: LSTM and Transformer encoder-decoders, an encoder, a per-step MLP.

Two are not in the paper: an MLP that sees the nodes on either side, and a bidirectional LSTM.

Each maps the derivatives of a path at N nodes, (B, N, I), to h and cos ψ there, (B, N, 2); means and scales are stored
with the weights. The networks work with log h: h is more than ten times larger near ends at rest than elsewhere, and
these ends would dominate the loss. The logarithm and the sizes are not in the paper: see `SIZES`.

If `answers` are given, a node's previous answer is the true one (teacher forcing), else the network's.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from enum import StrEnum
from functools import partial
from itertools import pairwise
from types import MappingProxyType
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

OUTPUTS = 2  # h and cos ψ


class Kind(StrEnum):
    """The architectures of Table 1, and two others."""

    LSTM = "LSTM"
    TRANSFORMER = "Transformer"
    ENCODER = "ETransformer"
    MLP = "MLP"
    NEIGHBOURS = "MLP-neighbours"
    BIDIRECTIONAL = "BiLSTM"


class Size(NamedTuple):
    """Width and number of layers, each for encoder and decoder."""

    width: int
    layers: int


SIZES = MappingProxyType({
    Kind.LSTM: Size(96, 1), Kind.TRANSFORMER: Size(64, 2), Kind.ENCODER: Size(64, 3), Kind.MLP: Size(192, 3),
    Kind.NEIGHBOURS: Size(192, 3), Kind.BIDIRECTIONAL: Size(64, 2),
})  # fmt: skip
HEADS = 4
MAX_LOG = 10.0  # bound of |log h|: larger values are failures of the network


class SequenceNetwork(nn.Module, ABC):
    """Base class of the networks: normalises inputs and outputs."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        self.mean, self.scale = nn.Buffer(torch.zeros(inputs)), nn.Buffer(torch.ones(inputs))
        self.middle, self.spread = nn.Buffer(torch.zeros(OUTPUTS)), nn.Buffer(torch.ones(OUTPUTS))

    def set_units(self, inputs: Tensor, answers: Tensor) -> None:
        """Set means and scales from data, (R, N, I) and (R, N, 2)."""
        self.mean.copy_(inputs.mean((0, 1)))
        self.scale.copy_(inputs.std((0, 1)).clamp_min(1e-6))
        logs = _with_logarithm(answers)
        self.middle.copy_(logs.mean((0, 1)))
        self.spread.copy_(logs.std((0, 1)).clamp_min(1e-6))

    def forward(self, inputs: Tensor, answers: Tensor | None = None) -> Tensor:
        """Map (B, N, I) to (B, N, 2); with `answers`, (B, N, 2), by teacher forcing."""
        seen = (inputs - self.mean) / self.scale
        fed = None if answers is None else self.scaled(answers)
        found = self.middle + self.spread * self.answer(seen, fed)
        return torch.stack([found[..., 0].clamp(-MAX_LOG, MAX_LOG).exp(), found[..., 1]], -1)

    def scaled(self, answers: Tensor) -> Tensor:
        """Return answers in normalised form, in which the loss is computed."""
        return (_with_logarithm(answers) - self.middle) / self.spread

    @abstractmethod
    def answer(self, seen: Tensor, fed: Tensor | None) -> Tensor:
        """Map normalised inputs to normalised answers."""


class LstmEncoderDecoder(SequenceNetwork):
    """The paper's choice: parameter-free attention from decoder to encoder, with answers fed back."""

    def __init__(self, inputs: int, size: Size) -> None:
        super().__init__(inputs)
        self.encoder = nn.LSTM(inputs, size.width, size.layers, batch_first=True)
        self.decoder = nn.LSTM(OUTPUTS + inputs, size.width, size.layers, batch_first=True)
        self.head = nn.Linear(2 * size.width, OUTPUTS)

    def answer(self, seen: Tensor, fed: Tensor | None) -> Tensor:
        """See SequenceNetwork."""
        memory, state = self.encoder(seen)
        first = seen.new_zeros(len(seen), 1, OUTPUTS)
        if fed is not None:
            decoded, _ = self.decoder(torch.cat([torch.cat([first, fed[:, :-1]], 1), seen], 2), state)
            return self._head(memory, decoded)
        answers = [first]
        for n in range(seen.shape[1]):
            decoded, state = self.decoder(torch.cat([answers[-1], seen[:, n : n + 1]], 2), state)
            answers.append(self._head(memory, decoded))
        return torch.cat(answers[1:], 1)

    def _head(self, memory: Tensor, decoded: Tensor) -> Tensor:
        weights = torch.softmax(decoded @ memory.transpose(1, 2) / memory.shape[2] ** 0.5, 2)
        answers: Tensor = self.head(torch.cat([decoded, weights @ memory], 2))
        return answers


class TransformerEncoderDecoder(SequenceNetwork):
    """Self-attention over the path, and a causally masked decoder with cross-attention that is fed its answers."""

    def __init__(self, inputs: int, size: Size) -> None:
        super().__init__(inputs)
        self.enter, self.enter_answers = nn.Linear(inputs, size.width), nn.Linear(OUTPUTS, size.width)
        options: dict[str, Any] = {"dropout": 0.0, "batch_first": True, "norm_first": True}
        encoding = nn.TransformerEncoderLayer(size.width, HEADS, 4 * size.width, **options)
        decoding = nn.TransformerDecoderLayer(size.width, HEADS, 4 * size.width, **options)
        norms = nn.LayerNorm(size.width), nn.LayerNorm(size.width)
        self.encoder = nn.TransformerEncoder(encoding, size.layers, norms[0], enable_nested_tensor=False)
        self.decoder = nn.TransformerDecoder(decoding, size.layers, norms[1])
        self.head = nn.Linear(size.width, OUTPUTS)

    def answer(self, seen: Tensor, fed: Tensor | None) -> Tensor:
        """See SequenceNetwork."""
        memory = self.encoder(placed(self.enter(seen)))
        first = seen.new_zeros(len(seen), 1, OUTPUTS)
        if fed is not None:
            return self._decode(torch.cat([first, fed[:, :-1]], 1), memory)
        answers = first
        for _ in range(seen.shape[1]):
            answers = torch.cat([answers, self._decode(answers, memory)[:, -1:]], 1)
        return answers[:, 1:]

    def _decode(self, before: Tensor, memory: Tensor) -> Tensor:
        mask = nn.Transformer.generate_square_subsequent_mask(before.shape[1], device=before.device)
        entered = placed(self.enter_answers(before))
        answers: Tensor = self.head(self.decoder(entered, memory, tgt_mask=mask, tgt_is_causal=True))
        return answers


class EncoderTransformer(SequenceNetwork):
    """Self-attention over the path and a head at each node: nothing is fed back."""

    def __init__(self, inputs: int, size: Size) -> None:
        super().__init__(inputs)
        self.enter = nn.Linear(inputs, size.width)
        layer = nn.TransformerEncoderLayer(
            size.width, HEADS, 4 * size.width, dropout=0.0, batch_first=True, norm_first=True
        )
        norm = nn.LayerNorm(size.width)
        self.encoder = nn.TransformerEncoder(layer, size.layers, norm, enable_nested_tensor=False)
        self.head = nn.Linear(size.width, OUTPUTS)

    def answer(self, seen: Tensor, fed: Tensor | None) -> Tensor:
        """See SequenceNetwork."""
        answers: Tensor = self.head(self.encoder(placed(self.enter(seen))))
        return answers


class BidirectionalLstm(SequenceNetwork):
    """Reads the path in both directions, with a head at each node: nothing is fed back."""

    def __init__(self, inputs: int, size: Size) -> None:
        super().__init__(inputs)
        self.layers = nn.LSTM(inputs, size.width, size.layers, batch_first=True, bidirectional=True)
        self.head = nn.Linear(2 * size.width, OUTPUTS)

    def answer(self, seen: Tensor, fed: Tensor | None) -> Tensor:
        """See SequenceNetwork."""
        answers: Tensor = self.head(self.layers(seen)[0])
        return answers


class StepMlp(SequenceNetwork):
    """Answers node by node, as in the paper from the path there and the previous answer.

    With more reach, from the path within `reach` nodes and that many previous answers.
    """

    def __init__(self, inputs: int, size: Size, reach: int = 0) -> None:
        super().__init__(inputs)
        self.reach, self.fed = reach, max(reach, 1)
        widths = [(2 * reach + 1) * (inputs + 1) + self.fed * OUTPUTS] + [size.width] * size.layers
        layers = [part for i, o in pairwise(widths) for part in (nn.Linear(i, o), nn.ReLU())]
        self.layers = nn.Sequential(*layers, nn.Linear(size.width, OUTPUTS))

    def answer(self, seen: Tensor, fed: Tensor | None) -> Tensor:
        """See SequenceNetwork."""
        there = torch.cat([seen, torch.ones_like(seen[..., :1])], 2)  # marks nodes on the path; padding is 0
        window = 2 * self.reach + 1
        around = nn.functional.pad(there, (0, 0, self.reach, self.reach)).unfold(1, window, 1).flatten(2)
        before = seen.new_zeros(len(seen), self.fed, OUTPUTS)
        if fed is not None:
            last = torch.cat([before, fed[:, :-1]], 1).unfold(1, self.fed, 1).flatten(2)
            answers: Tensor = self.layers(torch.cat([around, last], 2))
            return answers
        for n in range(seen.shape[1]):
            known = torch.cat([around[:, n], before[:, -self.fed :].transpose(1, 2).flatten(1)], 1)
            before = torch.cat([before, self.layers(known)[:, None]], 1)
        return before[:, self.fed :]


_NETWORKS: dict[Kind, Callable[[int, Size], SequenceNetwork]] = {
    Kind.LSTM: LstmEncoderDecoder, Kind.TRANSFORMER: TransformerEncoderDecoder, Kind.ENCODER: EncoderTransformer,
    Kind.MLP: StepMlp, Kind.NEIGHBOURS: partial(StepMlp, reach=8), Kind.BIDIRECTIONAL: BidirectionalLstm,
}  # fmt: skip


def build_network(kind: Kind, inputs: int, size: Size | None = None) -> SequenceNetwork:
    """Return a network with random weights from torch's generator."""
    return _NETWORKS[kind](inputs, size or SIZES[kind])


def _with_logarithm(answers: Tensor) -> Tensor:
    return torch.stack([answers[..., 0].clamp_min(math.exp(-MAX_LOG)).log(), answers[..., 1]], -1)


def placed(values: Tensor) -> Tensor:
    """Add sinusoidal positional encodings to (B, N, W)."""
    count, width = values.shape[1:]
    rates = torch.exp(torch.arange(0, width, 2) * (-math.log(1e4) / width))
    angles = torch.arange(count)[:, None] * rates
    return values + torch.stack([angles.sin(), angles.cos()], 2).flatten(1).to(values)
