"""From a recording to a result."""
