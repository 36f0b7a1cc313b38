"""Heat and melting: conduction, boundary conditions, latent heat, softening springs."""
