"""Demonstrations: their collection, where an algorithm gets them from, noise."""
