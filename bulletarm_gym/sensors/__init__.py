"""What an agent sees of the scene."""
