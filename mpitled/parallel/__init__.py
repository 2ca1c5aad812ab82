"""Ranks: the part of the model on each, and what they exchange."""
