"""A soft robot that learns to walk."""
