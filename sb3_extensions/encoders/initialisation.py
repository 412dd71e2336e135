"""Initial weights of plain layers."""

from torch import nn

SMALL_GAIN = 0.01
"""Gain of normalised output layers: an untrained actor has means near 0 and standard deviations near 1, and
an untrained critic has values near 0."""


def initialise_xavier(module: nn.Module) -> None:
    """Initialise a convolution or a linear layer with Xavier normal weights and zero biases."""
    if isinstance(module, nn.Conv2d | nn.Linear):
        nn.init.xavier_normal_(module.weight)
        if module.bias is not None:
            nn.init.zeros_(module.bias)


def initialise_output(layer: nn.Module, gain: float) -> None:
    """Initialise a linear layer or a convolution: Xavier uniform weights times ``gain``, zero biases."""
    assert isinstance(layer, nn.Conv2d | nn.Linear)
    nn.init.xavier_uniform_(layer.weight, gain=gain)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
