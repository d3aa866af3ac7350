"""The search for a cascade: synthetic views in, a file of boxes, cuts and weights out.

views -> samples -> boost -> write, round after round; :mod:`headvox.evolve.search` is the loop. LightGBM and CMA-ES
search, and nothing of them is left in the file: the detector evaluates it with its own integer kernels.
"""
