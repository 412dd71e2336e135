"""How tasks are solved: waypoints, and the tools that plans are made of."""

from bulletarm_gym.experts.waypoints import CLOSED, HALF_OPEN, OPEN, Waypoint

__all__ = ["CLOSED", "HALF_OPEN", "OPEN", "Waypoint"]
