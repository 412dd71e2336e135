"""How the arm is commanded."""

from bulletarm_gym.control.close_loop import CloseLoop, DeltaMove

__all__ = ["CloseLoop", "DeltaMove"]
