"""Common parts of the inertial estimators: preintegration, parameters, factors, priors, normal equations."""
