"""Demonstrations: episodes of an expert, their collection and validation, and learning from them."""
