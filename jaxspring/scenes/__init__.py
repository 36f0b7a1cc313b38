"""Ready-made scenes."""
