"""Models of what was matched, at once or in parts."""
