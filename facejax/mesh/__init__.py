"""Triangle meshes: connectivity, normals, closest points, decimation, spirals and spiral convolution."""
