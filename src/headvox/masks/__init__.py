"""Masks as data: what a cascade file says, its reader, its compiler, and its description in words and pictures."""
