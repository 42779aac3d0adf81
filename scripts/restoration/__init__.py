"""Training of the restoration networks: data, network, loop. Needs the extra ``train``."""
