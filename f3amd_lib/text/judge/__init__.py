"""The judge of text to motion: its network, its training, and what it says."""
