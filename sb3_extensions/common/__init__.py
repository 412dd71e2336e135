"""Modules that several algorithms share: checkpoints, action sequences, and checks of arguments."""
