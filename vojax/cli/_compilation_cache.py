"""JAX's persistent compilation cache in the user's cache folder: the second start compiles nothing."""

import hashlib
import os
import pathlib
import platform
import sys

import jax


def cache_folder() -> pathlib.Path:
    """Where the platform wants a program's caches: XDG, macOS or Windows style."""
    home = pathlib.Path.home()
    if os.environ.get("XDG_CACHE_HOME"):
        base = pathlib.Path(os.environ["XDG_CACHE_HOME"])
    elif sys.platform == "darwin":
        base = home / "Library" / "Caches"
    elif sys.platform == "win32":
        base = pathlib.Path(os.environ.get("LOCALAPPDATA", home / "AppData" / "Local"))
    else:
        base = home / ".cache"
    return base / "vojax" / "jax"


def processor_name() -> str:
    """A folder name for this kind of processor: programs of another kind may not run, and home folders are shared."""
    features = platform.processor()
    try:
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as lines:
            features = next((line for line in lines if line.startswith(("flags", "Features"))), features)
    except OSError:
        pass
    return f"{platform.machine()}-{hashlib.sha256(features.encode()).hexdigest()[:8]}"


def enable_compilation_cache() -> str | None:
    """Keep every compiled program on disk. Call it before JAX compiles anything.

    A cache that the user has set up (`JAX_COMPILATION_CACHE_DIR`) is left alone.

    Returns:
        None, or a sentence that says why there is no cache; nothing but time is lost.
    """
    if jax.config.jax_compilation_cache_dir:  # type: ignore[attr-defined]
        return None
    try:
        folder = cache_folder() / processor_name()
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError) as error:
        return f"no folder for compiled programs ({error}); the next start will compile again"
    if not os.access(folder, os.W_OK | os.X_OK):
        return f"{folder} cannot be written to; the next start will compile again"
    jax.config.update("jax_compilation_cache_dir", str(folder))
    # Dozens of small programs make up most of a warm start: keep them all.
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return None
