"""From heads to tracks."""
