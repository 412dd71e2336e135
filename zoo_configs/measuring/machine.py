"""With which versions of what a result was made."""

from __future__ import annotations

from bulletarm_gym import machine

PACKAGES = ("bulletarm-gym", "torch", "stable-baselines3", "gymnasium", "pybullet", "numpy")


def describe_arithmetic() -> str:
    """
    What the bits of a result depend on besides versions.

    :return: Kind of the processor, and how many threads PyTorch computes with
    """
    import llvmlite.binding
    import torch

    return f"{llvmlite.binding.get_host_cpu_name()}, {torch.get_num_threads()} threads"


def versions() -> dict[str, str]:
    """
    What a result depends on besides the machine.

    :return: From package to its version; that of Python, too
    """
    return machine.versions(PACKAGES)
