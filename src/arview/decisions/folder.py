"""The decisions that belong to an inspection: where their log is, and checked additions to it."""

from __future__ import annotations

from pathlib import Path

from arview.decisions.entry import Decision, checked_name, checked_text
from arview.decisions.log import DecisionLog
from arview.decisions.record import RecordState, record_state
from arview.errors import InputError
from arview.inspection import Inspection, Verdict, load_inspection
from arview.inspection.fingerprint import fingerprint_of_file

_FILE = "decisions.jsonl"


def inspection_path(target: str | Path) -> Path:
    """``inspection.json`` of a folder, or the file itself."""
    path = Path(target)
    return path / "inspection.json" if path.is_dir() else path


def decisions_path(target: str | Path) -> Path:
    """The log of a job folder or of an inspection.

    It is ``decisions.jsonl`` beside ``inspection.json``; of an inspection of another name, ``NAME.decisions.jsonl``.
    """
    path = inspection_path(target)
    return path.with_name(_FILE if path.name == "inspection.json" else f"{path.stem}.{_FILE}")


def log_of(target: str | Path) -> DecisionLog:
    """The log of a job folder or of an inspection."""
    return DecisionLog(decisions_path(target))


def state_of_record(target: str | Path, inspection: Inspection | None = None) -> RecordState:
    """What people decided about the inspection of a folder or file.

    Args:
        target: folder or inspection.
        inspection: of the file, if it has been read.

    Raises:
        InputError: the inspection or the log cannot be read.
    """
    path = inspection_path(target)
    return record_state(inspection or load_inspection(path), fingerprint_of_file(path), log_of(path).content())


def decide_component(
    target: str | Path, component: str, is_ok: bool, reason: str, note: str = "", by: str = "",
    photo: str | None = None,
) -> Decision:  # fmt: skip
    """Add a decision about a component of the inspection of a folder or file, and check what it says.

    Raises:
        InputError: the inspection has no such component, a component that did not pass is accepted without a reason,
            the folder has no such photo, or as `DecisionLog.decide`.
        OutputError: the log cannot be written.
    """
    path, inspection = _read(target)
    name = checked_name(component, "component")
    entry = inspection.find(name)
    if entry is None:
        known = ", ".join(one.name for one in inspection.components)
        raise InputError(f"{path}: the inspection has no component {name!r}; it has: {known}")
    has_passed = entry.verdict in (Verdict.PASS, Verdict.MEASURED)
    text = checked_text(reason, "reason", required=not (is_ok and has_passed))
    if photo is not None:
        _check_photo(path.parent, photo)
    return log_of(path).decide(name, is_ok, text, note, by, photo, fingerprint_of_file(path))


def tick_step(target: str | Path, component: str, step: int, is_done: bool, by: str) -> Decision:
    """Add the tick of a step of the rework of a component of the inspection of a folder or file.

    Raises:
        InputError: the inspection has no such component, or as `DecisionLog.tick`.
        OutputError: the log cannot be written.
    """
    path, inspection = _read(target)
    name = checked_name(component, "component")
    if inspection.find(name) is None:
        raise InputError(f"{path}: the inspection has no component {name!r}")
    return log_of(path).tick(name, step, is_done, by)


def sign_inspection(target: str | Path, by: str, note: str = "") -> Decision:
    """Sign the inspection of a folder or file as it is now.

    Raises:
        InputError: there is no inspection, or as `DecisionLog.sign`.
        OutputError: the log cannot be written.
    """
    path, _ = _read(target)
    return log_of(path).sign(by, note, fingerprint_of_file(path))


def _read(target: str | Path) -> tuple[Path, Inspection]:
    path = inspection_path(target)
    if not path.is_file():
        raise InputError(f"{path}: no such inspection; give a job folder or an inspection.json")
    return path, load_inspection(path)


def _check_photo(folder: Path, photo: object) -> None:
    """Check that a photo is one of the folder, where the folder keeps photos."""
    name = checked_name(photo, "photo")
    if "/" in name or "\\" in name or name.startswith("."):
        raise InputError(f"photo: {name!r} is not the name of a photo")
    photos = folder / "photos"
    if photos.is_dir() and not (photos / name).is_file():
        raise InputError(f"photo: there is no {name} in {photos}")
