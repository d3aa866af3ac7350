"""Pictures of what was found: every frame drawn without a display, as a png, a gif or an mp4."""
