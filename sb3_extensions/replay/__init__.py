"""Replay: images quantised and stored once; rows of an expert, priorities, rotated copies."""
