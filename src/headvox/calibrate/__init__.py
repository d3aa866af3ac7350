"""Where cameras stand, from what they see: the floor gives gravity and height, people who walk about the rest."""
