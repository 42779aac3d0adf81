"""Commands from beginning to end, and their outputs."""
