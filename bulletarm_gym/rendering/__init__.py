"""How a scene is drawn as seen from straight above."""
