"""How models of text to motion are trained, stage by stage, kept and found."""
