"""What estimators from inertial data share: preintegration, parameters, factors, priors, normal equations."""
