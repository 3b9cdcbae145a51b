"""Libraries that not everybody needs: which extra of the package each belongs to, and the command that installs it."""

from __future__ import annotations

import json
import shlex
import shutil
import sys
from collections.abc import Iterable
from importlib import import_module
from importlib.metadata import PackageNotFoundError, distribution
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

from arview.errors import MissingDependencyError

MODULES: dict[str, dict[str, str]] = {
    "measure": {"pycolmap": "pycolmap"},
    "cloud": {"open3d": "Open3D", "laspy": "laspy", "lazrs": "lazrs", "pye57": "pye57"},
    "report": {
        "jinja2": "Jinja2", "markupsafe": "MarkupSafe", "matplotlib": "Matplotlib", "weasyprint": "WeasyPrint",
        "pydyf": "pydyf", "lxml": "lxml",
    },
    "station": {
        "aiortc": "aiortc", "cryptography": "cryptography", "h11": "h11", "ifaddr": "ifaddr", "segno": "segno",
        "starlette": "Starlette", "tomlkit": "tomlkit", "uvicorn": "uvicorn",
    },
    "plant": {"aiomqtt": "aiomqtt", "asyncua": "asyncua", "msgspec": "msgspec"},
    "quality": {"sqlalchemy": "SQLAlchemy"},
    "postgres": {"psycopg": "psycopg"},
    "batch": {"bokeh": "bokeh", "dask": "Dask", "distributed": "Dask", "fsspec": "fsspec", "tornado": "tornado"},
    "formats": {"DracoPy": "DracoPy", "OCP": "cadquery-ocp-novtk", "pillow_heif": "pillow-heif", "rawpy": "rawpy"},
    "gpu": {"kornia": "kornia", "torch": "torch"},
}  # fmt: skip
"""For each extra of pyproject.toml the modules that it brings, and their names for people."""


def is_installed(module: str) -> bool:
    """Whether a module can be found, without importing it."""
    try:
        return find_spec(module) is not None
    except (ImportError, ValueError):  # hidden by a finder, or by None in sys.modules
        return False


def require(purpose: str, *modules: str) -> None:
    """Check that optional libraries are installed, without importing them: before long work starts.

    Args:
        purpose: what needs them, as the beginning of a sentence: ``reading HEIC photos``.
        modules: names of `MODULES`.

    Raises:
        MissingDependencyError: at least one is missing.
    """
    missing = [name for name in modules if not is_installed(name)]
    if missing:
        raise MissingDependencyError(_missing_text(purpose, missing))


def load(purpose: str, module: str) -> Any:
    """Import an optional library; arguments as for `require`.

    Raises:
        MissingDependencyError: it is missing, or cannot be loaded because a library of the system is.
    """
    require(purpose, module)
    try:
        return import_module(module)
    except (ImportError, OSError) as error:
        name = MODULES[_extra_of(module)][module]
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise MissingDependencyError(
            f"{purpose} needs {name}, which is installed but cannot be loaded ({reason})"
        ) from error


def require_extra(purpose: str, extra: str) -> None:
    """Check that all libraries of an extra are installed; as `require`."""
    require(purpose, *MODULES[extra])


def install_command(*extras: str) -> str:
    """The command that installs extras into this environment.

    arview is not on a package index, so the command names the copy that this installation was made from.
    """
    names = ",".join(extras)
    pip = "pip"
    found = shutil.which("pip")
    if found is None or Path(found).parent != Path(sys.executable).parent:
        pip = f"{shlex.quote(sys.executable)} -m pip"
    source, is_editable = _source()
    if source is None:
        return f"in the folder of arview: {pip} install '.[{names}]'"
    return f"{pip} install {'-e ' if is_editable else ''}{shlex.quote(_with_extras(source, names))}"


def _missing_text(purpose: str, missing: Iterable[str]) -> str:
    missing = list(missing)
    extras = list(dict.fromkeys(_extra_of(name) for name in missing))
    names = list(dict.fromkeys(MODULES[_extra_of(name)][name] for name in missing))
    verb = "is" if len(names) == 1 else "are"
    return f"{purpose} needs {', '.join(names)}, which {verb} not installed; run: {install_command(*extras)}"


def _extra_of(module: str) -> str:
    return next(extra for extra, modules in MODULES.items() if module in modules)


def _with_extras(source: str, names: str) -> str:
    """A source of pip with extras: ``/path[names]``, or ``arview[names] @ url``."""
    return f"arview[{names}] @ {source}" if "://" in source else f"{source}[{names}]"


def _source() -> tuple[str | None, bool]:
    """Where arview was installed from, as pip takes it, and whether the installation is editable; None: not known."""
    folder = Path(__file__).resolve().parents[3]
    if _is_source(folder):
        return str(folder), True
    try:
        record = json.loads(distribution("arview").read_text("direct_url.json") or "{}")
    except (PackageNotFoundError, OSError, ValueError):
        return None, False
    url, vcs = record.get("url", ""), record.get("vcs_info")
    if vcs:
        return f"{vcs['vcs']}+{url}@{vcs['commit_id']}", False
    place = urlsplit(url)
    if place.scheme != "file":
        return (url or None), False
    path = Path(unquote(place.path))
    return (str(path), False) if _is_source(path) or path.is_file() else (None, False)


def _is_source(folder: Path) -> bool:
    """Whether a folder is a copy of arview's repository."""
    try:
        return 'name = "arview"' in (folder / "pyproject.toml").read_text(encoding="utf-8")
    except OSError:
        return False
