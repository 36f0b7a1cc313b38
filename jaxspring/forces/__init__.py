"""Forces, and the physics of one spring."""
