"""Agents to load: small files with a card of what they are and can do, in the package or on a hub."""
