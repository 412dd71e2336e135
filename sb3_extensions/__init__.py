"""Stable-Baselines3 extensions for learning robotic manipulation from images and demonstrations."""
