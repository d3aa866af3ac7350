"""A detector on an NVIDIA GPU: the same grid, sums, candidates, scores and peaks as on the CPU, bit for bit.

What is fitted to the peaks, spheres and poses, is the same within a tolerance: see docs/cuda.md.

One module a stage, as on the CPU, and the same scalar rules: :mod:`headvox.cuda.lanes` compiles the Python functions
of the CPU's rules for the device. Nothing here is imported unless a detector is told to use it.

As on the CPU, kernels and rules have no type hints: see :mod:`headvox.machine.kernels`.
"""
