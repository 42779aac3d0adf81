"""Loops of a long capture: sought, selected by a pose graph, closed in the model."""
