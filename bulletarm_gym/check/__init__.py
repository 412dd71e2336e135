"""Checks of the machine, of environments and of robots: ``python -m bulletarm_gym.check``."""
