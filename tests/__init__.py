"""Tests, and what they share; a package, as other distributions install folders of this name."""
