"""Synthetic people, heads, scenes and depth cameras with exact ground truth."""
