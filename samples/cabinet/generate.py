"""Makes the sample cabinet, a painted panel with rails and small screws: the STEP file, the photos and their truth.

    generate.py step                    cabinet.step
    generate.py truth                   truth.json and camera.json
    generate.py photos [--first A --last B]   photos/img_000.jpg …; skips existing ones
    generate.py set                     the three above and part.toml: a folder that can be measured
    generate.py as-built                as_built.ply: the mesh that is rendered (not shipped)
    generate.py verify [--draw DIR]     errors of the truth at the edges of the photos, px
    generate.py sfm                     pycolmap's defaults against the truth (in arview's environment)

--seed N makes another set, with other displacements, camera, poses, light, clutter and textures, in the folder -o.
See ../plate/README.md for the packages that each step needs.
"""

import sys
from pathlib import Path

FOLDER = Path(__file__).resolve().parent
sys.path.insert(0, str(FOLDER.parent / "common"))

import photo_set  # noqa: E402  # found by the line above
from sample import KIND  # noqa: E402

if __name__ == "__main__":
    photo_set.main(KIND, FOLDER, __doc__)
