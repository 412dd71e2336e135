"""Curves, films and tables."""
