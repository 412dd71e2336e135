"""Experiments and their hyperparameters."""
