"""Hyperparameters, search spaces, presets and the command line ``bulletarm-zoo``."""
