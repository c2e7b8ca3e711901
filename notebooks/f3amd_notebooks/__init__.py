"""What the theory notebooks need beside the library: toys, closed forms, checks of exercises."""
