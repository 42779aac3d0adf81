"""What each sensor of a device says of a model's scale, and all of them together."""
