"""Noise schedules and samplers: they know arrays and a denoiser, neither motion nor model."""
