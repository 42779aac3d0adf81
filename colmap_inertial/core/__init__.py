"""Values, geometry, errors, options: what everything stands on."""
