"""Modules that several algorithms share: checkpoints, seeds, validation, metadata of environments."""
