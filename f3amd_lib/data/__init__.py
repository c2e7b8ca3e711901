"""Data sets by name, features and training windows: from motion to the arrays a network sees."""
