"""Models as `init` and `apply` pairs on plain pytrees."""
