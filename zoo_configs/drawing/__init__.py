"""Figures, videos and tables."""
