"""Every file that a user names is read and written here."""

from facejax.io import film, gltf, landmarks, meshes, page, props, render, scene
from facejax.io.export import save
from facejax.io.meshes import read as load_mesh

__all__ = ["film", "gltf", "landmarks", "load_mesh", "meshes", "page", "props", "render", "save", "scene"]
