"""Timing and the hardware it was done on; nothing here speaks about quality."""
