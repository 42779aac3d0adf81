"""Steps in an output folder: each is done once, and its output is whole or absent."""
