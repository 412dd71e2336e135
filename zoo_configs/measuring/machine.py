"""With which versions of what a result was made."""

from __future__ import annotations

from bulletarm_gym import machine

PACKAGES = ("bulletarm-gym", "torch", "stable-baselines3", "gymnasium", "pybullet", "numpy")


def versions() -> dict[str, str]:
    """
    What a result depends on besides the machine.

    :return: From package to its version; that of Python, too
    """
    return machine.versions(PACKAGES)
