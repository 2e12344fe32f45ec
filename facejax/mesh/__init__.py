"""Fixed connectivity: the hierarchy that a decoder climbs, its spirals, and array operations on meshes."""
