"""From noise and a caption to motion."""
