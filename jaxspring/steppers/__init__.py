"""Steppers: how a state is advanced by one step, and how large a step may be."""
