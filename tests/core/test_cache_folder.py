"""Where what can be made again is kept."""

from __future__ import annotations

from pathlib import Path

import pytest

from arview.core.cache_folder import cache_folder


def test_the_environment_says_where_the_cache_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("ARVIEW_CACHE", str(tmp_path / "own"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "own"
    monkeypatch.delenv("ARVIEW_CACHE")
    assert cache_folder() == tmp_path / "arview"
    monkeypatch.delenv("XDG_CACHE_HOME")
    assert cache_folder() == Path.home() / ".cache" / "arview"
