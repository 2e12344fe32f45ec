"""Models: pure `init` and `apply` functions on plain pytrees of parameters."""
