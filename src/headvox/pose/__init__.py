"""The pose fit: from a candidate to a 6-DoF head, by a template that is aligned to the raw points."""
