"""How a run works: its folder, its steps and their resumption, options as TOML, progress."""
