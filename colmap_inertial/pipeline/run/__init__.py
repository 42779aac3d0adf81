"""A run: its folder, its steps and their resumption, options as TOML, progress."""
