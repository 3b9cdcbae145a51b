"""Pictures of a board: from photos or a video to corners, with the accuracy to expect of each picture.

Corners are found by OpenCV's ChArUco detector (Garrido-Jurado et al. 2014) and refined where the squares meet; boards
without markers are found by `arview.calibration.plain_boards`. Pictures
are used as the sensor recorded them, before the rotation that makes them upright: portrait and landscape photos of one
phone calibrate one camera, which is what `load_camera` expects.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from arview.calibration.board_view import MIN_CORNERS, BoardView, blur_of
from arview.calibration.diagnosis import diagnose_missing_board, diagnose_missing_plain_board
from arview.calibration.plain_boards import PlainBoardFinder
from arview.camera import PHOTO_SUFFIXES, PhotoExif
from arview.core.progress import StepProgress
from arview.errors import InputError
from arview.fiducials import Board, cv_board
from arview.geometry import Array

_FRAMES_PER_S = 5.0
"""Frames of a video that are searched per second; a hand-held camera hardly moves in between."""
_MAX_FRAMES = 400
"""Frames of a video that are searched at most."""


@dataclass(frozen=True)
class BoardSightings:
    """What the pictures show.

    Attributes:
        label: name of the source, for messages.
        width, height: of the sensor's picture, px.
        views: pictures with the board.
        rejected: why a picture is not used, by its name.
        searched: number of pictures.
        exif: EXIF data of the first used photo, or of the video.
        quarter_turns_clockwise: from the sensor's picture to the upright one, of most pictures.
        warnings: messages.
    """

    label: str
    width: int
    height: int
    views: tuple[BoardView, ...]
    rejected: dict[str, str]
    searched: int
    exif: PhotoExif
    quarter_turns_clockwise: int = 0
    warnings: tuple[str, ...] = ()


@dataclass
class BoardFinder:
    """Finds the corners of one ChArUco board in grey pictures, also of OpenCV before 4.6 (legacy pattern)."""

    board: Board
    markers_seen: list[tuple[Array, NDArray[np.int64]]] = field(default_factory=list)
    """Corners (N,4,2) and ids (N,) of the markers in pictures with too few board corners, for the diagnosis."""

    def __post_init__(self) -> None:
        import cv2

        if not self.board.is_charuco:
            raise InputError(
                f"{self.board}: calibration needs a ChArUco board (`arview calibrate board` prints one), a"
                " checkerboard or a grid of circles"
            )
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._parameters = parameters
        self._detectors = [self._detector(False)]
        if self.board.rows % 2 == 0:
            self._detectors.append(self._detector(True))

    def find(self, name: str, gray: NDArray[np.uint8]) -> BoardView | str:
        """The view of a picture (H,W) uint8, or the reason why there is none."""
        for detector in list(self._detectors):
            corners, ids, quads, marker_ids = detector.detectBoard(gray)
            if ids is not None and len(ids) >= MIN_CORNERS:
                self._detectors = [detector]
                points = np.asarray(detector.getBoard().getChessboardCorners(), dtype=np.float64)
                number = np.asarray(ids).ravel().astype(np.int64)
                pixels = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
                if detector.getBoard().checkCharucoCornersCollinear(np.asarray(ids)):
                    return "shows only one line of the board's corners"
                return BoardView(name, number, points[number], pixels, blur_of(gray, pixels))
        found = 0 if marker_ids is None else len(marker_ids)
        if found == 0:
            return "shows no marker of the board"
        self.markers_seen.append(
            (np.asarray(quads, dtype=np.float64).reshape(-1, 4, 2), np.asarray(marker_ids).ravel().astype(np.int64))
        )
        count = 0 if ids is None else len(ids)
        return f"shows {found} markers and {count} corners of the board; {MIN_CORNERS} are needed"

    def _detector(self, is_legacy: bool) -> Any:
        import cv2

        drawn = cv_board(self.board)
        if is_legacy:
            drawn.setLegacyPattern(True)
        details = cv2.aruco.CharucoParameters()
        # One of the two markers beside a corner suffices, to reach the border, where distortion is largest.
        details.minMarkers = 1
        return cv2.aruco.CharucoDetector(drawn, details, self._parameters)


def find_views(sources: Sequence[str | Path], board: Board, progress: StepProgress | None = None) -> BoardSightings:
    """Search for the board in photos, or in one video.

    Args:
        sources: photo files, folders or globs of these; or one video file.
        board: the board to find.
        progress: called with pictures done and in all.

    Raises:
        InputError: no source can be read, no camera took more than half of the pictures, or none of them shows the
            board; the message says what was found instead.
    """
    finder = BoardFinder(board) if board.is_coded else PlainBoardFinder(board)
    if not sources:
        raise InputError("expected photos of the board, or a video of it")
    if len(sources) == 1 and _is_video(Path(sources[0])):
        sightings = _views_of_video(Path(sources[0]), finder, progress)
    else:
        sightings = _views_of_photos(sources, finder, progress)
    if not sightings.views:
        pictures, searched = _some_pictures(sources), sightings.searched
        if isinstance(finder, PlainBoardFinder):
            reason = diagnose_missing_plain_board(board, finder.sizes_seen, searched, pictures)
        else:
            reason = diagnose_missing_board(board, finder.markers_seen, searched, list(pictures))
        raise InputError(f"{sightings.label}: {reason}")
    return sightings


# --- photos ------------------------------------------------------------------------------------------------


def _views_of_photos(
    sources: Sequence[str | Path], finder: BoardFinder | PlainBoardFinder, progress: StepProgress | None
) -> BoardSightings:
    """Search for the board in photos; those of another lens than most are left out."""
    from arview.reconstruction import photo_paths

    paths: list[Path] = []
    for source in sources:
        paths += photo_paths(source)[0]
    paths, names = photo_paths(list(paths))
    label = str(sources[0]) if len(sources) == 1 else f"{len(paths)} photos"
    exifs, rejected = _exif_of_all(paths, names)
    if not exifs:
        why = "; ".join(f"{name} {reason}" for name, reason in list(rejected.items())[:3])
        raise InputError(f"{label}: none of the {len(paths)} photos can be read ({why})")
    chosen, others = _one_lens(label, exifs)
    rejected |= others
    views = []
    for done, (path, name) in enumerate(zip(paths, names, strict=True), 1):
        if name in chosen:
            found = _view_of_photo(path, name, chosen[name].quarter_turns_clockwise, finder)
            if isinstance(found, BoardView):
                views.append(found)
            else:
                rejected[name] = found
        if progress:
            progress(done, len(paths))
    first = next(iter(chosen.values()))
    width, height = _sensor_size(first)
    turns = Counter(exif.quarter_turns_clockwise for exif in chosen.values()).most_common(1)[0][0]
    warnings = []
    if others:
        warnings.append(
            f"{len(others)} of {len(paths)} photos are of another camera, zoom or size and are left out: "
            f"{', '.join(list(others)[:4])}; calibrate these separately"
        )
    return BoardSightings(
        label,
        width,
        height,
        views=tuple(views),
        rejected=rejected,
        searched=len(paths),
        exif=first,
        quarter_turns_clockwise=turns,
        warnings=tuple(warnings),
    )


def _exif_of_all(paths: Sequence[Path], names: Sequence[str]) -> tuple[dict[str, PhotoExif], dict[str, str]]:
    """EXIF data of the photos, and why others cannot be read, both by name."""
    from arview.camera import read_exif

    exifs, rejected = {}, {}
    for path, name in zip(paths, names, strict=True):
        try:
            exifs[name] = read_exif(path)
        except InputError as error:
            rejected[name] = str(error).removeprefix(f"{path}: ")
    return exifs, rejected


def _one_lens(label: str, exifs: dict[str, PhotoExif]) -> tuple[dict[str, PhotoExif], dict[str, str]]:
    """The photos of the lens that took more than half of them, and why the others are left out."""
    from arview.reconstruction import Lens, lenses_of

    turned = []
    for exif in exifs.values():
        width, height = _sensor_size(exif)
        turned.append(replace(exif, width=width, height=height, orientation=1))
    lenses, _ = lenses_of(turned, None)
    keys = [lens.key if isinstance(lens, Lens) else "?" for lens in lenses]
    counts = Counter(keys).most_common()
    if len(counts) > 1 and 2 * counts[0][1] <= len(keys):
        listed = "; ".join(f"{count} of {key}" for key, count in counts[:4])
        raise InputError(
            f"{label}: photos of {len(counts)} cameras, zooms or sizes ({listed}); give those of one, because each has"
            " its own calibration"
        )
    main = counts[0][0]
    chosen = {name: exif for (name, exif), key in zip(exifs.items(), keys, strict=True) if key == main}
    others = {name: f"is of {key}, not of {main}" for name, key in zip(exifs, keys, strict=True) if key != main}
    return chosen, others


def _sensor_size(exif: PhotoExif) -> tuple[int, int]:
    """Width and height of the sensor's picture, before it is rotated upright."""
    width, height = exif.upright_size
    return (height, width) if exif.quarter_turns_clockwise % 2 else (width, height)


def _view_of_photo(path: Path, name: str, turns: int, finder: BoardFinder | PlainBoardFinder) -> BoardView | str:
    """The view of one photo, or the reason why there is none."""
    import cv2

    from arview.reconstruction import read_photo

    try:
        upright = read_photo(path)
    except InputError as error:
        return str(error).removeprefix(f"{path}: ")
    gray = cv2.cvtColor(upright, cv2.COLOR_RGB2GRAY)
    return finder.find(name, np.ascontiguousarray(np.rot90(gray, turns)))


# --- video -------------------------------------------------------------------------------------------------


def _is_video(path: Path) -> bool:
    """Whether a file is taken for a video: it exists and is not a photo by its suffix."""
    return path.is_file() and path.suffix.lower() not in PHOTO_SUFFIXES


def _views_of_video(
    path: Path, finder: BoardFinder | PlainBoardFinder, progress: StepProgress | None
) -> BoardSightings:
    """Search for the board in the frames of a video."""
    import cv2

    from arview.camera import exif_of_video
    from arview.video import open_source

    with open_source(path) as source:
        fps, count = source.fps or 30.0, source.frame_count
    stride = max(1, round(fps / _FRAMES_PER_S), -(-(count or 0) // _MAX_FRAMES))
    views: list[BoardView] = []
    rejected: dict[str, str] = {}
    searched = 0
    with open_source(path, stride=stride) as source:
        turns = source.quarter_turns_clockwise
        before: BoardView | None = None
        before_s = 0.0
        for frame in source:
            searched += 1
            gray = np.rot90(cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY), turns)
            found = finder.find(f"frame {frame.index}", np.ascontiguousarray(gray))
            if isinstance(found, BoardView):
                speed = _speed_px_s(before, found, frame.time_s - before_s)
                before, before_s = found, frame.time_s
                views.append(replace(found, speed_px_s=speed))
            else:
                before = None
                rejected[f"frame {frame.index}"] = found
            if progress and source.frame_count:
                progress(min(searched, source.frame_count), source.frame_count)
        ended = source.ended_reason
        size = (source.height, source.width) if turns % 2 else (source.width, source.height)
    if searched == 0:
        raise InputError(f"{path}: no frame could be read; record or copy the video again")
    warnings = (ended,) if ended else ()
    exif = exif_of_video(path, *size)
    return BoardSightings(str(path), *size, tuple(views), rejected, searched, exif, turns, warnings)


def _speed_px_s(before: BoardView | None, now: BoardView, seconds: float) -> float:
    """Median speed of the corners that two successive views share; 0 if unknown."""
    if before is None or seconds <= 0.0:
        return 0.0
    _, here, there = np.intersect1d(now.ids, before.ids, return_indices=True)
    if len(here) < 4:
        return 0.0
    return float(np.median(np.linalg.norm(now.pixels[here] - before.pixels[there], axis=1)) / seconds)


# --- both --------------------------------------------------------------------------------------------------


def _some_pictures(sources: Sequence[str | Path], count: int = 5) -> Iterator[NDArray[np.uint8]]:
    """About ``count`` grey pictures of the sources, for the diagnosis."""
    import cv2

    from arview.reconstruction import photo_paths, read_photo
    from arview.video import open_source

    if len(sources) == 1 and _is_video(Path(sources[0])):
        with open_source(sources[0]) as source:
            stride = max(1, (source.frame_count or 60) // count)
        with open_source(sources[0], stride=stride) as source:
            for frame in source:
                yield cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY)
        return
    paths = [path for item in sources for path in photo_paths(item)[0]]
    for path in paths[:: max(1, len(paths) // count)]:
        try:
            yield cv2.cvtColor(read_photo(path), cv2.COLOR_RGB2GRAY)
        except InputError:
            continue
