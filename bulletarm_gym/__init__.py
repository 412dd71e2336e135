"""Manipulation tasks of the BulletArm paper as Gymnasium environments."""
