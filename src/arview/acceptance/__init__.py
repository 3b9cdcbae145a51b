"""Acceptance test with calibrated lengths after VDI/VDE 2634 part 1."""

from typing import TYPE_CHECKING

from arview.core.doors import lazy_door

if TYPE_CHECKING:
    from arview.acceptance.comparison import compare as compare
    from arview.acceptance.comparison import comparison_record as comparison_record
    from arview.acceptance.conformity import FULL_TEST as FULL_TEST
    from arview.acceptance.conformity import LengthResult as LengthResult
    from arview.acceptance.conformity import UncertaintyCheck as UncertaintyCheck
    from arview.acceptance.conformity import Verification as Verification
    from arview.acceptance.conformity import parse_limit as parse_limit
    from arview.acceptance.conformity import record_of as record_of
    from arview.acceptance.conformity import verify as verify
    from arview.acceptance.lengths import read_known as read_known
    from arview.acceptance.lengths import read_measured as read_measured
    from arview.acceptance.plot import draw as draw
    from arview.acceptance.position_list import ListedComponent as ListedComponent
    from arview.acceptance.position_list import is_position_list as is_position_list
    from arview.acceptance.position_list import read_position_list as read_position_list

__getattr__, __dir__, __all__ = lazy_door(
    __name__,
    {
        "comparison": (
            "compare",
            "comparison_record",
        ),
        "conformity": (
            "FULL_TEST",
            "LengthResult",
            "UncertaintyCheck",
            "Verification",
            "parse_limit",
            "record_of",
            "verify",
        ),
        "lengths": (
            "read_known",
            "read_measured",
        ),
        "plot": ("draw",),
        "position_list": (
            "ListedComponent",
            "is_position_list",
            "read_position_list",
        ),
    },
)
