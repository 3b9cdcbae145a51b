"""The re-check of components that were put right: a few photos of them, placed among those of the first measurement."""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from arview import measurement, reconstruction, workflow
from arview.cad import Part
from arview.camera import Camera
from arview.core.messages import sentence
from arview.core.stage_cache import write_json
from arview.errors import ArviewError, CannotMeasureError, InputError
from arview.geometry import Array
from arview.inspection import ComponentDeviation, Inspection, load_inspection, save_inspection, verdict_sentence
from arview.rendering import ZBufferRenderer
from arview.station.walk.job import JobFolder
from arview.station.walk.preparation import photo_files, poses_of
from arview.station.walk.worker import WalkWorker, prepared_of
from arview.workflow.new_inspection import new_inspection

_DRAWN_PX = 1000
"""Longer side at which components are drawn to find the features on them."""
_UNKNOWN_MM = 20.0
"""How far from its place a component may have been that was missing or not measured."""


class RecheckWorker(WalkWorker):
    """Works on one re-check until it is done.

    Args:
        job: the re-check.
    """

    def __init__(self, job: JobFolder) -> None:
        super().__init__(job)
        parent = job.parent
        if parent is None:
            raise InputError(f"job {job.id}: is no re-check")
        self.first = parent
        self.memory = reconstruction.SparseMemory(parent.path / "features")
        self.earlier: reconstruction.EarlierPhotos | None = None

    def _wait_for_first_photo(self) -> workflow.Prepared:
        """Make the earlier photos ready, which needs none of the new ones."""
        if self.state.stage == "done":
            return prepared_of(self.first)
        self._say(text=sentence("walk.first"))
        prepared = prepared_of(self.first)
        measurement.check_not_datums(prepared.part, self.job.components or ())
        self.scale, whole, photos = read_first(self.first)
        before = load_inspection(self.first.path / "inspection.json", prepared.part.model)
        hides = Hides(prepared.part, before, self.job.components or (), whole, self.scale)
        options = reconstruction.AddedOptions(sparse=prepared.reconstruct.sparse)
        self.earlier = reconstruction.EarlierPhotos(whole, photos, hides, options, self.memory)
        super()._wait_for_first_photo()
        return prepared

    def _prepare_more(self, photos: Sequence[reconstruction.Photo]) -> None:
        """Match new photos with those of the first measurement."""
        if self.earlier is None:
            return
        sparse = self.earlier.options.sparse
        features = [
            self.memory.features(photo, sparse.features, reconstruction.torch_device(sparse.device)) for photo in photos
        ]
        poses = {name: self._from_scan(pose) for name, pose in poses_of(self.job.photos()).items()}
        self.earlier.match(photos, features, poses)

    def _measure_roughly(self, prepared: workflow.Prepared, count: int) -> bool:
        """A re-check has so few photos that it is measured once."""
        return True

    def _finish(self, prepared: workflow.Prepared) -> None:
        """The measurement of the components in the new photos."""
        if self.state.stage == "done":
            return
        self.job.remove_unconfirmed()
        photos = self.job.photos()
        self._say(stage="measuring", text=sentence("walk.measuring"), photos=len(photos))
        assert self.earlier is not None
        prefix = f"recheck/{self.job.path.name}/photos/"
        options = replace(prepared.reconstruct, last_stage="photos")
        source = photo_files(self.job, photos)
        try:
            intake = reconstruction.reconstruct(
                source, self.job.path / "rough" / "photos", None, prepared.job.camera, options
            ).intake
        except InputError as error:
            raise CannotMeasureError(str(error)) from error
        new = [replace(photo, name=prefix + photo.name) for photo in intake.photos]
        poses = {prefix + name: self._from_scan(pose) for name, pose in poses_of(photos).items()}
        folder = self.job.path
        sparse = self.earlier.add(new, poses, folder / "sparse", self._progress())
        reconstruction.write_sparse(folder / "sparse", sparse)
        shutil.copyfile(self.first.path / "scale.json", folder / "scale.json")
        listed = reconstruction.intake_summary(replace(intake, photos=(*self.earlier.photos, *new)))
        write_json(folder / "photos.json", listed)
        scale, frame = self.scale.scale, self.scale.model_from_scan
        assert scale is not None and frame is not None
        metric = measurement.MetricReconstruction(sparse.transformed(scale, frame), self.scale, None)
        try:
            found = measurement.measure_again(
                metric,
                prepared.part,
                self.job.components or (),
                [photo.name for photo in new],
                prepared.measure,
                progress=self._progress(),
            )
        except InputError as error:
            raise CannotMeasureError(str(error)) from error
        inspection = self._whole(found, prepared.part, sparse.unplaced)
        save_inspection(inspection, folder / "inspection.json")
        self._say_verdict(inspection, False)
        self._report(prepared.part)
        self._say(cloud="done", step="")
        self._add_to_history()

    def _from_scan(self, cam_from_model: Array) -> Array:
        """The rotation of a tracked pose as one from the scan frame."""
        assert self.scale.model_from_scan is not None
        return cam_from_model @ self.scale.model_from_scan

    def _whole(self, found: Inspection, part: Part, unplaced: Sequence[tuple[str, str]]) -> Inspection:
        """The inspection of the whole part, in which only what was checked again has values."""
        measured = {one.name: one for one in found.components}
        rest = {one.name: one for one in new_inspection(part).components}
        first = self.first.id
        components: list[ComponentDeviation] = []
        for name, one in rest.items():
            if name in measured:
                components.append(measured[name])
            elif one.details is not None:
                note = f"not checked again; see the first measurement, {first}"
                components.append(replace(one, details=replace(one.details, notes=(note,))))
        note = f"re-check of {', '.join(measured)}, registered to the datums of {first}"
        left_out = tuple(f"{Path(name).name}: {reason}" for name, reason in unplaced)
        return replace(
            found,
            components=tuple(components),
            warnings=(*found.warnings, *left_out),
            provenance=replace(found.provenance, tool="arview walk", note=note),
        )

    def _say_verdict(self, inspection: Inspection, was_done: bool) -> None:
        checked = tuple(one for one in inspection.components if one.name in (self.job.components or ()))
        super()._say_verdict(inspection, was_done)
        self._say(text=verdict_sentence(replace(inspection, components=checked)))

    def _report(self, part: Part) -> None:
        """Write the report, and what the first measurement's report says of re-checks."""
        super()._report(part)
        with contextlib.suppress(ArviewError):
            from arview.report import update_reports

            update_reports(self.first.path)


def read_first(
    first: JobFolder,
) -> tuple[reconstruction.ScaleResult, reconstruction.SparseModel, list[reconstruction.Photo]]:
    """Scale, sparse model in the scan frame and photos of a finished measurement.

    Raises:
        InputError: files of it are missing or damaged.
    """
    folder = first.path
    try:
        scale = reconstruction.ScaleResult.from_provenance(
            json.loads((folder / "scale.json").read_text(encoding="utf-8"))
        )
        entries: list[dict[str, Any]] = json.loads((folder / "photos.json").read_text(encoding="utf-8"))["photos"]
        photos = [_photo(entry, folder) for entry in entries]
        sparse = reconstruction.read_model(folder / "sparse", photos)
    except (OSError, ValueError, RuntimeError, KeyError, TypeError) as error:
        raise InputError(f"{folder}: the first measurement is missing or damaged ({error}); measure anew") from error
    if scale.scale is None or scale.model_from_scan is None:
        raise InputError(f"{folder}: the first measurement has no frame; measure anew")
    return scale, sparse, photos


def _photo(entry: Mapping[str, Any], folder: Path) -> reconstruction.Photo:
    """A photo of ``photos.json``, where it is now; its camera is a placeholder for that of the model."""
    name, width, height = str(entry["name"]), int(entry["width"]), int(entry["height"])
    path = folder / "photos" / name if (folder / "photos" / name).is_file() else Path(str(entry["path"]))
    camera = Camera(width, height, float(width), float(width), 0.5 * width, 0.5 * height)
    return reconstruction.Photo(name, path, width, height, str(entry["lens"]), camera)


class Hides:
    """Which pixels of the first photos show components that have moved since, at their nominal or measured place.

    Args:
        part: the part.
        before: the first measurement.
        components: names of what has moved.
        whole: the reconstruction, in the scan frame.
        scale: its scale and frame.
    """

    def __init__(
        self,
        part: Part,
        before: Inspection,
        components: Sequence[str],
        whole: reconstruction.SparseModel,
        scale: reconstruction.ScaleResult,
    ) -> None:
        assert scale.scale is not None and scale.model_from_scan is not None
        self.photos: tuple[reconstruction.PosedPhoto, ...] = whole.transformed(
            scale.scale, scale.model_from_scan
        ).photos
        self.model = part.model.only(list(components))
        moved = [one.distance_mm for one in before.components if one.name in components]
        self.margin_mm = 1.0 + max([_UNKNOWN_MM if one is None else one for one in moved], default=_UNKNOWN_MM)

    def __call__(self, index: int, pixels: NDArray[np.float32]) -> NDArray[np.bool_]:
        """(N,) which of the pixels (N,2) of a photo lie on these components, or near them."""
        photo = self.photos[index]
        shrink = min(1.0, _DRAWN_PX / max(photo.camera.width, photo.camera.height))
        ideal = photo.camera.without_distortion()
        camera = ideal.scaled(round(ideal.width * shrink), round(ideal.height * shrink))
        depth = ZBufferRenderer(self.model, camera).render(photo.cam_from_scan).depth_mm
        seen = depth > 0.0
        if not seen.any():
            return np.zeros(len(pixels), dtype=np.bool_)
        margin_px = int(np.ceil(camera.fx / float(np.median(depth[seen])) * self.margin_mm)) + 3
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin_px + 1, 2 * margin_px + 1))
        near = cv2.dilate(seen.astype(np.uint8), kernel) > 0
        rays = photo.camera.unproject(pixels.astype(np.float64))
        u = np.rint(rays[:, 0] * camera.fx + camera.cx)
        v = np.rint(rays[:, 1] * camera.fy + camera.cy)
        inside = np.isfinite(u) & np.isfinite(v) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        hidden = np.zeros(len(pixels), dtype=np.bool_)
        hidden[inside] = near[v[inside].astype(np.intp), u[inside].astype(np.intp)]
        return hidden
