"""Replay buffer: quantised storage, samplers, n-step returns and augmentation."""
