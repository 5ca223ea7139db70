"""The networks in torch: a bidirectional LSTM, and the paper's encoder-decoder LSTM with attention.

Each maps the features of a window to three numbers a node (see training_set.Batch.targets), and normalises them by
numbers that are stored with its weights. inference.py computes the same without torch.
"""

from enum import StrEnum
from typing import Any

import torch
from torch import Tensor, nn

from cfplan.learning.features import INPUTS, OUTPUTS


class Architecture(StrEnum):
    """The architectures by name, as on the command line and in model cards."""

    BILSTM = "bilstm"  # sees the whole window from both sides, answers for all nodes at once
    ENCODER_DECODER = "attention"  # the paper's: encoder, dot-product attention, autoregressive decoder


class BiLstm(nn.Module):
    """A bidirectional LSTM with a linear head at each node."""

    def __init__(self, hidden: int, layers: int) -> None:
        super().__init__()
        self.mean = nn.Buffer(torch.zeros(INPUTS))
        self.scale = nn.Buffer(torch.ones(INPUTS))
        self.lstm = nn.LSTM(INPUTS, hidden, layers, batch_first=True, bidirectional=True)
        self.head = nn.Linear(2 * hidden, OUTPUTS)

    def forward(self, inputs: Tensor, _: Tensor | None = None) -> Tensor:
        """Map (B, W+1, INPUTS) to (B, W+1, OUTPUTS)."""
        hidden, _state = self.lstm((inputs - self.mean) * self.scale)
        return self.head(hidden)


class EncoderDecoder(nn.Module):
    """The paper's LSTM encoder-decoder: each answer is an input of the next, attention has no parameters.

    No model that comes with cfplan uses it; it is kept to train and to compare with the paper.
    """

    def __init__(self, hidden: int, layers: int) -> None:
        super().__init__()
        self.mean = nn.Buffer(torch.zeros(INPUTS))
        self.scale = nn.Buffer(torch.ones(INPUTS))
        self.encoder = nn.LSTM(INPUTS, hidden, layers, batch_first=True)
        self.decoder = nn.LSTM(OUTPUTS, hidden, layers, batch_first=True)
        self.head = nn.Linear(2 * hidden, OUTPUTS)

    def forward(self, inputs: Tensor, targets: Tensor | None = None) -> Tensor:
        """Map (B, W+1, INPUTS) to (B, W+1, OUTPUTS); with targets, each step is fed the true answer before it."""
        memory, state = self.encoder((inputs - self.mean) * self.scale)
        first = inputs.new_zeros(len(inputs), 1, OUTPUTS)
        if targets is not None:
            return self._answer(memory, self.decoder(torch.cat([first, targets[:, :-1]], dim=1), state)[0])
        answers = [first]
        for _ in range(inputs.shape[1]):
            step, state = self.decoder(answers[-1], state)
            answers.append(self._answer(memory, step))
        return torch.cat(answers[1:], dim=1)

    def _answer(self, memory: Tensor, decoded: Tensor) -> Tensor:
        weights = torch.softmax(decoded @ memory.transpose(1, 2) / memory.shape[2] ** 0.5, dim=2)
        return self.head(torch.cat([decoded, weights @ memory], dim=2))


NETWORKS: dict[Architecture, type[BiLstm] | type[EncoderDecoder]] = {
    Architecture.BILSTM: BiLstm,
    Architecture.ENCODER_DECODER: EncoderDecoder,
}


def build(architecture: Architecture, hidden: int, layers: int) -> Any:
    """Return a network with random weights, by torch's seed."""
    return NETWORKS[architecture](hidden, layers)
