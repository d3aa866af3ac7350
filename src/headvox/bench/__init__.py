"""The command ``headvox bench``."""
