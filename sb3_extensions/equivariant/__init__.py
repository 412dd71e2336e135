"""Layers that commute with rotations and reflections, independent of reinforcement learning."""
