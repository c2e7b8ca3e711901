"""Captioned motions, encoders of captions, redundant vectors and meshes."""
