"""Spectral blocks, conditioning and the networks of the paper, by the paper's names."""
