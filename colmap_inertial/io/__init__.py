"""Readers: what users' files hold, in SI units and one set of axes, with typed errors."""
