"""Cloth in measured units: hung, draped, blown, and the tests of a fabric laboratory."""
