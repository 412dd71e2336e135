"""Hyperparameters: axes, rules, and the cells that they make."""
