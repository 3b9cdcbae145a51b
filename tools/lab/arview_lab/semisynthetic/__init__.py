"""Semi-synthetic sequences: CAD rendered along known trajectories over real photos, as BOP scenes."""

from arview_lab.semisynthetic.ambiguity import indistinguishable_poses, nearest_error
from arview_lab.semisynthetic.backgrounds import photos_in
from arview_lab.semisynthetic.conditions import CONDITIONS, Conditions
from arview_lab.semisynthetic.curved_shapes import CURVED_SHAPES, curved_shape
from arview_lab.semisynthetic.look_alikes import LookAlike, look_alikes, with_absent
from arview_lab.semisynthetic.make import (
    WALK_ROUND,
    Job,
    conditions_job,
    look_alike_job,
    make_sequence,
    read_record,
    shape_job,
)
from arview_lab.semisynthetic.negatives import frames_without_part
from arview_lab.semisynthetic.real_sequence import real_trajectory, render_real
from arview_lab.semisynthetic.sequence import (
    CAMERA,
    VARIANTS,
    SequenceFrame,
    SequenceOptions,
    Variant,
    render_sequence,
    trajectory,
)
from arview_lab.semisynthetic.shapes import BOX_SHAPES, SHAPES, near_symmetries, shape, symmetries_of
from arview_lab.semisynthetic.trajectory import TrajectoryOptions

__all__ = [
    "BOX_SHAPES",
    "CAMERA",
    "CONDITIONS",
    "CURVED_SHAPES",
    "SHAPES",
    "VARIANTS",
    "WALK_ROUND",
    "Conditions",
    "Job",
    "LookAlike",
    "SequenceFrame",
    "SequenceOptions",
    "TrajectoryOptions",
    "Variant",
    "conditions_job",
    "curved_shape",
    "frames_without_part",
    "indistinguishable_poses",
    "look_alike_job",
    "look_alikes",
    "make_sequence",
    "near_symmetries",
    "nearest_error",
    "photos_in",
    "read_record",
    "real_trajectory",
    "render_real",
    "render_sequence",
    "shape",
    "shape_job",
    "symmetries_of",
    "trajectory",
    "with_absent",
]
