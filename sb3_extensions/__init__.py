"""The BulletArm baselines as extensions of Stable-Baselines3."""
