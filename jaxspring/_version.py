"""The version of the library, written here and nowhere else in the code."""

__version__ = "0.1.0"
