"""Linear solvers that report how they ended."""
