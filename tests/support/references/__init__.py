"""Plain references: the same as a compiled kernel in a few obvious lines, compared with it exactly."""
