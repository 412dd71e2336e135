"""Networks: groups, equivariant layers, encoders, features extractors, heads, actors and critics."""
