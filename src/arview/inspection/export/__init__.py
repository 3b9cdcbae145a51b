"""Export of inspections to CSV, QIF, Q-DAS DFQ and GLB."""

from arview.inspection.export.csv_table import to_csv
from arview.inspection.export.dfq import to_dfq
from arview.inspection.export.glb import to_glb
from arview.inspection.export.qif import to_qif

__all__ = ["to_csv", "to_dfq", "to_glb", "to_qif"]
