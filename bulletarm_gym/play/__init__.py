"""Environments played with keys: ``python -m bulletarm_gym.play``."""
