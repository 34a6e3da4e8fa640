import pathlib
import sys

import jax
import jax.numpy as jnp
import pytest
from jax.experimental.compilation_cache import compilation_cache

from vojax.cli._compilation_cache import cache_folder, enable_compilation_cache, processor_name


def test_every_program_is_kept(own_cache_folder):
    assert enable_compilation_cache() is None
    folder = own_cache_folder / "vojax" / "jax" / processor_name()
    compilation_cache.reset_cache()  # In a process of its own nothing is compiled before.
    before = set(folder.iterdir())
    jax.jit(lambda x: x * 2.5 + 0.75)(jnp.ones(3)).block_until_ready()
    assert set(folder.iterdir()) - before


def test_the_users_own_cache_is_left_alone(tmp_path, own_cache_folder):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "mine"))
    assert enable_compilation_cache() is None
    assert jax.config.jax_compilation_cache_dir == str(tmp_path / "mine")
    assert not own_cache_folder.exists()


def test_no_folder_no_cache(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert "compile again" in enable_compilation_cache()
    assert not jax.config.jax_compilation_cache_dir


@pytest.mark.parametrize(
    ("platform", "folder"),
    [("linux", ".cache"), ("darwin", "Library/Caches"), ("win32", "AppData/Local")],
)
def test_folders_of_the_platforms(monkeypatch, platform, folder):
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.delenv("LOCALAPPDATA", raising=False)
    monkeypatch.setattr(sys, "platform", platform)
    assert cache_folder() == pathlib.Path.home() / folder / "vojax" / "jax"
