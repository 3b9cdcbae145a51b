"""Datums: their features in the CAD, their offsets measured in photos or a cloud, and the frame they define."""
