"""How fast: timing, machines, ahead-of-time export, and the baseline in other frameworks."""
