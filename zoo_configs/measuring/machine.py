"""On what, and with which versions of what, a result was made."""

from __future__ import annotations

from bulletarm_gym.check import machine

PACKAGES = ("bulletarm-gym", "torch", "stable-baselines3", "gymnasium", "pybullet", "numpy")


def describe_arithmetic() -> str:
    """
    What the bits of a result depend on besides versions.

    :return: Kind of the processor, and how many threads PyTorch computes with
    """
    import llvmlite.binding
    import torch

    return f"{llvmlite.binding.get_host_cpu_name()}, {torch.get_num_threads()} threads"


def describe_hardware(device: str = "cpu") -> str:
    """
    What a result is computed on.

    :param device: PyTorch device
    :return: Model and cores of the processor, and the model of the GPU that is used
    """
    processor = machine.describe_processor()
    if device == "cpu":
        return processor  # without importing PyTorch

    import torch
    from stable_baselines3.common.utils import get_device

    where = get_device(device)
    return f"{processor}, {torch.cuda.get_device_name(where)}" if where.type == "cuda" else processor


def versions() -> dict[str, str]:
    """
    What a result depends on besides the machine.

    :return: From package to its version; that of Python, too
    """
    return machine.versions(PACKAGES)
