"""Rotations, skeletons, BVH files and the synthetic walker: motion without any learning."""
