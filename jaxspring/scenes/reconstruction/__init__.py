"""Adaptive surface reconstruction: a spring mesh adapts to an image and recovers it as a piecewise linear surface."""
