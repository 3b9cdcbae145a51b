"""Printed boards and tags with coded markers: what they are, how they are drawn, and finding them in a picture."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.fiducials.board import DEFAULT_DICTIONARY as DEFAULT_DICTIONARY
    from arview.fiducials.board import Board as Board
    from arview.fiducials.board import Tags as Tags
    from arview.fiducials.board import cv_board as cv_board
    from arview.fiducials.board import dictionary_name as dictionary_name
    from arview.fiducials.board import parse_board as parse_board
    from arview.fiducials.board import parse_length_mm as parse_length_mm
    from arview.fiducials.board import parse_tags as parse_tags
    from arview.fiducials.board import spec_of as spec_of
    from arview.fiducials.board_sheet import board_pdf as board_pdf
    from arview.fiducials.board_sheet import fit_board as fit_board
    from arview.fiducials.board_sheet import parse_paper as parse_paper
    from arview.fiducials.board_sheet import place_board as place_board
    from arview.fiducials.serial_code import SerialCodeReader as SerialCodeReader
    from arview.fiducials.serial_code import SerialNumbers as SerialNumbers
    from arview.fiducials.targets import CornerKey as CornerKey
    from arview.fiducials.targets import find_corners as find_corners

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "board": (
            "Board",
            "DEFAULT_DICTIONARY",
            "Tags",
            "cv_board",
            "dictionary_name",
            "parse_board",
            "parse_length_mm",
            "parse_tags",
            "spec_of",
        ),
        "board_sheet": (
            "board_pdf",
            "fit_board",
            "parse_paper",
            "place_board",
        ),
        "serial_code": (
            "SerialCodeReader",
            "SerialNumbers",
        ),
        "targets": (
            "CornerKey",
            "find_corners",
        ),
    },
)
