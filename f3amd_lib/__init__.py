"""A readable companion to F3AMD, fast FiLM-conditioned Fourier autoregressive motion diffusion.

The library takes the paper's road from end to end: motion capture comes in as BVH, a denoiser made
of Fourier neural operators is trained on windows of it, an autoregressive rollout walks characters
of a chosen style along a chosen path, and metrics look at them. Rooms depend on each other in one
direction (docs/house.md has them in order): `motion`, `diffusion` and `networks` know nothing of data
sets; `training`, `rollout` and `measures` bring them together. Two papers on motion from text have a
wing of their own, `text`. What measures, judges, times, serves and exports is `f3amd_companion`.
Importing the package imports none of its rooms, so that looking at a BVH file does not start JAX.
"""

__version__ = "0.3.0"
