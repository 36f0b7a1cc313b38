"""Which nodes exist and which springs join them."""
