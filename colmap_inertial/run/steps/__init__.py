"""How steps run in an output folder: each is done once, and its output is whole or absent.

`session` opens and ends a run, `workspace` names every path of its folder, `runner` does steps or keeps them, `hashing`
makes the keys that decide which, `config` reads and writes options.
"""
