"""Checks of the machine and of robots: ``python -m bulletarm_gym.check``."""
