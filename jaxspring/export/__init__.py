"""States and runs as files that viewers read: VTK, XYZ, PLY."""
