"""A cell: from a trigger to a verdict, with cameras whose poses are known."""

from __future__ import annotations

import shutil
import time
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import cv2

from arview import calibration, measurement, overlay, reconstruction
from arview.cad import Part
from arview.core.atomic import write_file
from arview.errors import InputError
from arview.geometry import Array
from arview.inspection import Inspection, save_inspection
from arview.pose import ComponentPresence, Pose, Presence, TrackingState, Visibility
from arview.station.rig.cameras import RigCameras
from arview.station.rig.station_file import Station
from arview.workflow.new_inspection import new_inspection

METHODS: tuple[measurement.Method, ...] = ("edges",)
"""How components are measured: few cameras give the edges more than the surfaces, which need texture."""


@dataclass(frozen=True)
class Cycle:
    """What one cycle found.

    Attributes:
        inspection: with no component measured where the part was not found.
        folder: of its files: pictures, ``inspection.json``, pictures with labels.
        faults: a sentence for each camera, by its name, that gave no picture, has moved or does not show the part:
            nothing was measured from it.
        cams_from_model: pose of the part in each camera that was used.
        seconds: how long pictures, placing and measuring took.
    """

    inspection: Inspection
    folder: Path
    faults: dict[str, str] = field(default_factory=dict)
    cams_from_model: dict[str, Array] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)


class Cell:
    """A cell that measures one part after another.

    Args:
        station: see `Station`; its rig file must exist and name the same cameras.

    Raises:
        InputError: the rig is missing, damaged or of other cameras.
    """

    def __init__(self, station: Station) -> None:
        self.station = station
        self.rig = calibration.CameraRig.load(station.rig_path)
        names = tuple(one.name for one in station.cameras)
        if set(self.rig.names) != set(names):
            raise InputError(
                f"{station.rig_path}: is the rig of {', '.join(self.rig.names)}, but the station has"
                f" {', '.join(names)}; run `arview station calibrate` again"
            )
        for name, camera in zip(self.rig.names, self.rig.cameras, strict=True):
            own = next(one.camera for one in station.cameras if one.name == name)
            if (own.fx, own.cx, own.cy, own.width) != (camera.fx, camera.cx, camera.cy, camera.width):
                raise InputError(f"camera {name}: its lens was calibrated anew; run `arview station calibrate` again")
        self._before: reconstruction.RigPlacement | None = None

    def cycle(self, cameras: RigCameras, serial: str | None = None) -> Cycle:
        """Take a picture of each camera, and measure the part; its files are in a folder of their own.

        Raises:
            InputError: no source gives a picture any more.
            OutputError: a file cannot be written.
        """
        began = time.monotonic()
        folder = self._new_folder(serial)
        files, missing = cameras.save(folder)
        if not files:
            folder.rmdir()
            raise InputError(f"no camera gives a picture: {'; '.join(f'{k}: {v}' for k, v in missing.items())}")
        found_s = taken_s = time.monotonic()
        part = self.station.part if serial is None else replace(self.station.part, serial=serial)
        faults = {name: f"camera {name}: gave no picture: {why}" for name, why in missing.items()}
        warnings, poses = list(faults.values()), dict[str, Array]()
        try:
            with reconstruction.keeping_photos():
                placed = self._placed(files, part)
                faults |= {one.name: one.text for one in placed.moved}
                found_s = time.monotonic()
                seen = self.rig.posed({name: path for name, path in files.items() if name not in faults})
                inspection, poses = self._measured(seen, placed, part)
        except InputError as error:
            inspection = new_inspection(part, serial=serial)
            warnings.append(str(error))
        inspection = replace(
            inspection,
            warnings=(*warnings, *inspection.warnings),
            provenance=replace(inspection.provenance, tool="arview station"),
        )
        save_inspection(inspection, folder / "inspection.json")
        done_s = time.monotonic()
        self._remove_old()
        seconds = {"pictures": taken_s - began, "placing": found_s - taken_s, "measuring": done_s - found_s}
        return Cycle(inspection, folder, faults, cams_from_model=poses, seconds=seconds)

    def _placed(self, files: dict[str, Path], part: Part) -> reconstruction.RigPlacement:
        """Where the part lies, by the cameras that agree."""
        detail = f"rig of {len(self.rig.names)} cameras, from {self.rig.source}"
        known = reconstruction.ScaleEvidence("rig", 1.0, self.rig.scale_std, detail)
        placed = reconstruction.place_on_rig(self.rig.posed(files), part, known, self._before)
        self._before = self._before if placed.found is None else placed
        return placed

    def _measured(
        self, sparse: reconstruction.SparseModel, placed: reconstruction.RigPlacement, part: Part
    ) -> tuple[Inspection, dict[str, Array]]:
        """The inspection from the pictures of the cameras that agree, and the part's pose in each."""
        scale = placed.scale
        if placed.found is None or scale.scale is None or scale.model_from_scan is None:
            raise InputError(scale.why_no_frame or "the part is not found in the pictures")
        if not sparse.photos:
            raise InputError("the cameras contradict each other: run `arview station calibrate` again")
        metric = measurement.MetricReconstruction(sparse.transformed(scale.scale, scale.model_from_scan), scale, None)
        options = measurement.MeasureOptions(methods=METHODS)
        inspection = measurement.measure(metric, part, options, starts=placed.near_places)
        return inspection, {photo.name: photo.cam_from_scan for photo in metric.sparse.photos}

    def draw(self, cycle: Cycle) -> list[Path]:
        """Write each camera's picture with ghosts and labels, as ``NAME.jpg``."""
        paths = []
        presence = _presence(cycle.inspection, self.station.part)
        for name, pose in cycle.cams_from_model.items():
            camera = self.rig.cameras[self.rig.names.index(name)]
            renderer = overlay.OverlayRenderer(self.station.part.model, camera, cycle.inspection)
            picture = reconstruction.read_photo(cycle.folder / f"{name}.png")
            seen = Pose(pose, None, 1.0, state=TrackingState.TRACKED, time_s=0.0, index=0, components=presence)
            drawn = renderer.draw(picture, seen)
            _, content = cv2.imencode(".jpg", cv2.cvtColor(drawn, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, 88])
            paths.append(cycle.folder / f"{name}.jpg")
            write_file(paths[-1], content.tobytes())
        return paths

    def _new_folder(self, serial: str | None) -> Path:
        """An empty folder, named by time and serial number."""
        now = datetime.now(UTC)
        name = f"{now:%Y%m%dT%H%M%S}{now.microsecond // 1000:03d}Z"
        safe = "".join(one if one.isalnum() or one in "-_." else "_" for one in serial or "")[:60]
        folder = self.station.cycles / (f"{name}-{safe}" if safe else name)
        folder.mkdir(parents=True)
        return folder

    def _remove_old(self) -> None:
        """Remove the oldest cycles beyond those that are kept."""
        done = sorted(path for path in self.station.cycles.iterdir() if path.is_dir() and path.name[:8].isdecimal())
        for path in done[: max(0, len(done) - self.station.keep)]:
            shutil.rmtree(path, ignore_errors=True)


def _presence(inspection: Inspection, part: Part) -> dict[str, ComponentPresence]:
    """What the measurement says of each component's presence; the base is there, since the part was found by it."""
    found = {one.name: one.is_present for one in inspection.components}
    kinds = {True: Presence.PRESENT, False: Presence.MISSING, None: Presence.UNVERIFIED}
    return {
        one.name: ComponentPresence(kinds[found.get(one.name, True)], Visibility.VISIBLE, 1.0, 1, 0.0)
        for one in part.model.components
    }
