"""The smaller commands, and what all commands share."""
