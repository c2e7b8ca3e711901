"""What the papers print, and where they are silent: values in folders, and their readers."""
