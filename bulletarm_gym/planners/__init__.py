"""Experts: planners that turn a task's plan into actions."""

from bulletarm_gym.planners.waypoint import expert_action

__all__ = ["expert_action"]
