"""The decisions that belong to an inspection: where their log is, and checked additions to it.

A job folder may hold checks of reworked components, ``recheck/01``, ``recheck/02``, …, each with an
``inspection.json``. They belong to the record of the first measurement: there is one log, that of the first.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from arview.errors import InputError
from arview.inspection import (
    ComponentDeviation,
    Inspection,
    Verdict,
    component_fingerprint,
    fingerprint_of_file,
    load_inspection,
    values_fingerprint,
)
from arview.quality.decisions.attachments import attachment_faults, is_attachment, photo_fault
from arview.quality.decisions.entry import Decision, checked_name, checked_text
from arview.quality.decisions.log import DecisionLog
from arview.quality.decisions.record import Recheck, RecordState, record_state

_FILE = "decisions.jsonl"
_INSPECTION = "inspection.json"
_RECHECK = "recheck"


def inspection_path(target: str | Path) -> Path:
    """``inspection.json`` of a folder, or the file itself."""
    path = Path(target)
    return path / _INSPECTION if path.is_dir() else path


def first_inspection(target: str | Path) -> Path:
    """The inspection to whose record that of a folder or file belongs: of a re-check the first measurement's."""
    path = inspection_path(target)
    parents = path.resolve().parents
    if path.name == _INSPECTION and len(parents) > 2 and parents[1].name == _RECHECK:
        first = parents[2] / _INSPECTION
        if first.is_file():
            return first
    return path


def decisions_path(target: str | Path) -> Path:
    """The log of a job folder or of an inspection.

    It is ``decisions.jsonl`` beside ``inspection.json``; of an inspection of another name, ``NAME.decisions.jsonl``; of
    a re-check that of the first measurement.
    """
    path = first_inspection(target)
    return path.with_name(_FILE if path.name == _INSPECTION else f"{path.stem}.{_FILE}")


def log_of(target: str | Path) -> DecisionLog:
    """The log of a job folder or of an inspection."""
    return DecisionLog(decisions_path(target))


def rechecks_of(target: str | Path) -> list[tuple[Path, Recheck]]:
    """The finished checks of reworked components that belong to an inspection, in their order, with their files.

    Raises:
        InputError: one of them cannot be read.
    """
    first = first_inspection(target)
    if first.name != _INSPECTION:
        return []
    found = []
    for path in sorted((first.parent / _RECHECK).glob(f"*/{_INSPECTION}")):
        inspection = load_inspection(path)
        names = _checked_components(path.parent / "job.json")
        components = tuple(
            one
            for one in inspection.components
            if (one.name in names if names is not None else one.verdict is not Verdict.NOT_MEASURED)
        )
        photos = inspection.provenance.photos_hash
        found.append((path, Recheck(fingerprint_of_file(path), inspection.created, components, photos)))
    return found


def _checked_components(path: Path) -> list[str] | None:
    """Names of the components of a re-check as its job says; None if it does not."""
    try:
        names = json.loads(path.read_bytes())["components"]
    except (OSError, ValueError, TypeError, KeyError):
        return None
    return [str(one) for one in names] if isinstance(names, list) else None


def state_of_record(target: str | Path, inspection: Inspection | None = None) -> RecordState:
    """What people decided about the inspection of a folder or file; of a re-check about the first measurement's.

    Args:
        target: folder or inspection.
        inspection: of the file, if it has been read.

    Raises:
        InputError: the inspection, a re-check or the log cannot be read.
    """
    path = first_inspection(target)
    if inspection is None or path != inspection_path(target):
        inspection = load_inspection(path)
    rechecks = [check for _, check in rechecks_of(path)]
    content = log_of(path).content()
    state = record_state(inspection, fingerprint_of_file(path), content, rechecks)
    faults = attachment_faults(path.parent, content.entries)
    if not faults:
        return state
    sentence = state.sentence if state.faults else f"not valid: {faults[0]}"
    return replace(state, sentence=sentence, is_released=False, faults=(*state.faults, *faults))


def decide_component(
    target: str | Path,
    component: str,
    is_ok: bool,
    reason: str,
    note: str = "",
    by: str = "",
    photo: str | None = None,
) -> Decision:
    """Add a decision about a component of the inspection of a folder or file, and check what it says.

    It is about the newest measurement of the component. A photo of a re-check is kept as ``recheck/NN/NAME``; one that
    was taken for the decision has the name that `attach_photo` gave it.

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
    newest, photos_hash = _newest(path, entry)
    has_passed = newest.verdict in (Verdict.PASS, Verdict.MEASURED)
    text = checked_text(reason, "reason", required=not (is_ok and has_passed))
    kept = None if photo is None else _kept_photo(inspection_path(target), path, photo)
    sha256 = component_fingerprint(inspection, newest, photos_hash)
    return log_of(path).decide(name, is_ok, text, note, by, kept, sha256)


def _newest(path: Path, entry: ComponentDeviation) -> tuple[ComponentDeviation, str | None]:
    """The newest measurement of a component, and the hash of its photos; None for those of the first one."""
    for _, check in reversed(rechecks_of(path)):
        for one in check.components:
            if one.name == entry.name:
                return one, check.photos_hash
    return entry, None


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
    """Sign the inspection of a folder or file as it is now, with the checks of reworked components that belong to it.

    It is about the values and verdicts: it holds while they stay the same, whatever else is written of them.

    Raises:
        InputError: there is no inspection; a component failed that nobody decided about, and no note says why it is
            signed all the same; or as `DecisionLog.sign`.
        OutputError: the log cannot be written.
    """
    path, inspection = _read(target)
    undecided = () if note.strip() else state_of_record(path).undecided
    if failed := [one.name for one in inspection.components if one.verdict is Verdict.FAIL and one.name in undecided]:
        raise InputError(
            f"{', '.join(failed)}: out of tolerance, and nobody has decided about it; decide first, or give the reason"
            " of the concession as a note"
        )
    rechecks = [check.sha256 for _, check in rechecks_of(path)]
    return log_of(path).sign(by, note, values_fingerprint(inspection), rechecks)


def photo_path(target: str | Path, photo: str) -> Path | None:
    """The file of a photo that a decision names; None if the name is not one that `decide_component` makes."""
    folder = first_inspection(target).parent
    if is_attachment(photo):
        return folder / photo
    parts = photo.split("/")
    if len(parts) == 3 and parts[0] == _RECHECK:
        folder, parts = folder / _RECHECK / parts[1], parts[2:]
    if len(parts) != 1 or any(part.startswith(".") for part in photo.split("/")) or "\\" in photo:
        return None
    return folder / "photos" / parts[0]


def _read(target: str | Path) -> tuple[Path, Inspection]:
    """The first measurement that a folder or file belongs to."""
    path = inspection_path(target)
    if not path.is_file():
        raise InputError(f"{path}: no such inspection; give a job folder or an inspection.json")
    first = first_inspection(path)
    return first, load_inspection(first)


def _reconstructed_photos(folder: Path) -> set[str]:
    """Names of the photos of a reconstruction whose photos are kept elsewhere."""
    try:
        return {str(one["name"]) for one in json.loads((folder / "photos.json").read_bytes())["photos"]}
    except (OSError, ValueError, TypeError, KeyError):
        return set()


def _kept_photo(path: Path, first: Path, photo: object) -> str:
    """The name under which a photo of a folder is kept in the log of the first measurement, checked."""
    name = checked_name(photo, "photo")
    if is_attachment(name):
        if fault := photo_fault(first.parent, name):
            raise InputError(f"photo: {name} {fault}; take it again")
        return name
    if "/" in name or "\\" in name or name.startswith("."):
        raise InputError(f"photo: {name!r} is not the name of a photo")
    photos = path.parent / "photos"
    if not (photos / name).is_file() and (photos.is_dir() or name not in _reconstructed_photos(path.parent)):
        raise InputError(f"photo: there is no {name} in {photos}; name a photo of the job, or put it there")
    return name if path.resolve() == first.resolve() else f"{_RECHECK}/{path.resolve().parent.name}/{name}"
