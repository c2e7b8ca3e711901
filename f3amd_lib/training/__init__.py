"""Recipes, tasks, the one optimise loop that trains them, and checkpoints that resume exactly."""
