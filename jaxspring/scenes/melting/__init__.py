"""A block that melts on a hot plate."""
