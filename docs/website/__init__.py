"""Generated pages of the documentation: one page for each task, and the gallery."""
