"""Answers without torch are torch's own."""

import numpy as np
import pytest
import torch

from cfplan.learning import inference, networks
from cfplan.learning.features import INPUTS
from cfplan.learning.networks import Architecture, build


@pytest.mark.parametrize("architecture", Architecture)
@pytest.mark.parametrize(("hidden", "layers", "window"), [(5, 1, 8), (32, 2, 64), (67, 3, 20)])
def test_both_agree(architecture, hidden, layers, window):
    torch.manual_seed(hidden)
    network = build(architecture, hidden, layers)
    with torch.no_grad():
        for values in network.parameters():
            values.mul_(2.0)  # beyond where tanh is a line
        network.mean.normal_()
        network.scale.uniform_(0.5, 2.0)
        inputs = torch.randn(3, window + 1, INPUTS)
        expected = network(inputs).numpy()
    fast = inference.NETWORKS[str(architecture)]({k: v.numpy() for k, v in network.state_dict().items()})
    np.testing.assert_allclose(fast(inputs.numpy()), expected, atol=1e-5)


@pytest.mark.parametrize("architecture", Architecture)
def test_shapes_are_those_of_torch(architecture):
    state = build(architecture, 12, 2).state_dict()
    assert inference.tensor_shapes(str(architecture), 12, 2) == {
        name: tuple(values.shape) for name, values in state.items()
    }
    assert set(inference.NETWORKS) == {str(kind) for kind in networks.NETWORKS}


def test_the_decoder_is_fed_its_own_answers():
    """With the true answers before it, the attention network answers otherwise, and in one go."""
    torch.manual_seed(0)
    network = build(Architecture.ENCODER_DECODER, 8, 1)
    inputs = torch.randn(1, 9, INPUTS)
    with torch.no_grad():
        own = network(inputs)
        fed = network(inputs, own)
        other = network(inputs, own + 1.0)
    np.testing.assert_allclose(fed, own, atol=1e-6)
    assert (other - own).abs().max() > 1e-3
