"""Initial weights of plain layers."""

from torch import nn

OUTPUT_GAIN = 0.01
"""Gain of output layers. Heights in centimetres make features large. With this gain an untrained actor has
means near 0 and standard deviations near 1, and an untrained critic has values near 0."""


def initialise_xavier(module: nn.Module) -> None:
    """Initialise a convolution or a linear layer with Xavier normal weights and zero biases."""
    if isinstance(module, nn.Conv2d | nn.Linear):
        nn.init.xavier_normal_(module.weight)
        if module.bias is not None:
            nn.init.zeros_(module.bias)


def scale_down(layer: nn.Linear | nn.Conv2d) -> None:
    """Initialise an output layer near zero: Xavier uniform weights times :data:`OUTPUT_GAIN`, zero biases."""
    nn.init.xavier_uniform_(layer.weight, gain=OUTPUT_GAIN)
    if layer.bias is not None:
        nn.init.zeros_(layer.bias)
