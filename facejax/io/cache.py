"""The user's cache folder."""

import os
from pathlib import Path

import platformdirs


def folder() -> Path:
    """Return the cache folder: `$FACEJAX_CACHE`, or the platform's user cache. It is not created."""
    chosen = os.environ.get("FACEJAX_CACHE")
    return Path(chosen).expanduser() if chosen else Path(platformdirs.user_cache_dir("facejax"))
