"""Inverse problems: fitting parameters to data by gradients through a simulation."""
