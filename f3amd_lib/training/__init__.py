"""Losses, the training loop and checkpoints that resume exactly."""
