"""Experts: waypoints, and functions and classes that plan them."""

from bulletarm_gym.experts.waypoints import CLOSED, HALF_OPEN, OPEN, Waypoint

__all__ = ["CLOSED", "HALF_OPEN", "OPEN", "Waypoint"]
