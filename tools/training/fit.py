#!/usr/bin/env python
"""Fit what finds parts, and tells right poses from wrong ones, on random solids before photos. Needs torch and onnx.

  fit.py pictures --solids 60 --photos DIR   pictures and the lines in them, 60 for each, to out/judge
  fit.py lines --epochs 40                   the line network from that: out/judge/lines.onnx
  fit.py denoiser --epochs 70                the denoiser from that: out/judge/denoiser.onnx
  fit.py collect --solids 100 --photos DIR   what the detector tries on each, with the truth, to out/judge
  fit.py fit                                 the judge's networks from that: out/judge/judge.npz
  fit.py verifier                            the verifier's: out/judge/verifier.onnx
  fit.py cut --from 900 --solids 150 --photos DIR    strips across what the detector ends with, to out/judge
  fit.py strips --epochs 14                  the network that looks at them from that: out/judge/strips.onnx
  fit.py turn --from 40000 --solids 180 --photos DIR    poses of nearly symmetric solids and twins of them
  fit.py twins --epochs 8                    the network that tells them apart from that: out/judge/twins.onnx
  fit.py assemblies --solids 300 --photos DIR    components of random assemblies, right and wrong, to out/judge
  fit.py components                          the component network from that: out/judge/components.onnx
  fit.py probability --from 500 --solids 40 --photos DIR    what a quality must be made of, with these

  fit.py desks --solids 120 --photos DIR --things CUTOUTS    more backgrounds, to out/judge/desks

DIR holds at least 20 photos of anything but parts that will be looked for: what a photo shows, the networks take for
clutter. In few photos do many small things lie side by side as on a shop floor: `desks` strews cut-out pictures of
things (with transparency, such as those of Debian's tuxpaint-stamps-default) on parts of photos, one picture for each
number; put them beside the photos in DIR. A few hundred backgrounds are soon known by heart: Debian's wallpapers, games
and documentation hold 2,000 more (labelme-examples, cimg-doc, opencv-doc, redeclipse-data, supertuxkart-data,
ufoai-textures, flightgear-data-base, stellarium-data; leave out their maps of normals). Frames of the recordings in
fits cost the castle half of its detections.
Default: photos that Python packages and Debian's mate-backgrounds bring, and those in $ARVIEW_BACKGROUNDS.

`pictures` takes about 20 s and 10 MB each, `collect` about 40 s and 60 MB a solid, `cut` about 25 s and 15 MB,
`turn` about 10 s and 20 MB, `assemblies` about 10 s and 6 MB for each of the solids, a third, that are assemblies; all
may be run several times side by side with other --from; what is there is kept. `cut` needs solids that the verifier
was not fitted to. `lines`, `denoiser`, `fit`, `verifier`, `strips` and `components` with --go-on begin where those in
use stand, but for the judge's also wider or deeper.
Copy lines.onnx, denoiser.onnx, judge.npz, verifier.onnx, strips.onnx, twins.onnx and components.onnx from out/judge
over the package's (src/arview/tracking) to use them, one after the other: the later ones are fitted to what the search
finds with the earlier ones. EVIDENCE_WEIGHT and the weights of `probability` go to quality.py there.
The same seeds give the same pictures; what the threaded search tries in them varies a little from run to run.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))  # photos and recordings are shared

from arview.errors import ArviewError, InputError
from composite_backgrounds import make_desks
from confidence_fitting import fit_probability
from contour_examples import collect_strips
from contour_fitting import fit_strips
from denoiser_fitting import fit_denoiser
from edge_net_examples import collect_lined_pictures
from edge_net_fitting import fit_lines
from options import positive, seed
from pair_examples import collect_twins
from pair_fitting import fit_twins
from photos import fitting_photos
from pose_verifier_fitting import fit_verifier
from presence_net_examples import collect_components
from presence_net_fitting import fit_components
from profile_ranker_examples import collect_examples
from profile_ranker_fitting import fit_networks

STEPS = (
    "desks",
    "pictures",
    "lines",
    "denoiser",
    "collect",
    "fit",
    "verifier",
    "cut",
    "strips",
    "turn",
    "twins",
    "assemblies",
    "components",
    "probability",
)


def main() -> int:
    chosen = parser().parse_args()
    try:
        going_on = {
            "fit": fit_networks,
            "lines": fit_lines,
            "denoiser": fit_denoiser,
            "verifier": fit_verifier,
            "strips": fit_strips,
            "components": fit_components,
        }
        if chosen.go_on and chosen.what not in going_on:
            raise InputError(f"fit_judge: --go-on is for {', '.join(going_on)} only")
        if chosen.what in going_on:
            going_on[chosen.what](chosen.folder, chosen.epochs, not chosen.go_on)
            return 0
        if chosen.what == "twins":
            fit_twins(chosen.folder, chosen.epochs)
            return 0
        photos = fitting_photos(chosen.photos)
        seeds = range(chosen.first, chosen.first + chosen.solids)
        if chosen.what == "desks":
            if chosen.things is None:
                raise InputError("fit_judge: desks needs --things, a folder of pictures with transparency")
            make_desks(seeds, photos, chosen.things, chosen.folder / "desks")
        elif chosen.what == "pictures":
            collect_lined_pictures(seeds, photos, chosen.folder)
        elif chosen.what == "assemblies":
            collect_components(seeds, photos, chosen.folder)
        elif chosen.what == "cut":
            collect_strips(seeds, photos, chosen.folder)
        elif chosen.what == "turn":
            collect_twins(seeds, photos, chosen.folder)
        elif chosen.what == "collect":
            collect_examples(seeds, photos, chosen.folder)
        else:
            fit_probability(seeds, photos)
    except ArviewError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    return 0


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("what", choices=STEPS)
    made.add_argument("--from", dest="first", type=seed, default=0, metavar="N", help="first solid; default: 0")
    made.add_argument("--solids", type=positive, default=100, metavar="N", help="how many; default: 100")
    made.add_argument("--photos", type=Path, metavar="DIR", help="backgrounds; default: the machine's")
    made.add_argument("--things", type=Path, metavar="CUTOUTS", help="desks: pictures with transparency")
    made.add_argument("--epochs", type=positive, default=12, metavar="N", help="of the fit; default: 12")
    made.add_argument(
        "--go-on", action="store_true", help="networks: from the one in use; those of convolutions perhaps wider"
    )
    made.add_argument("--folder", type=Path, default=Path("out/judge"), help="default: out/judge")
    return made


if __name__ == "__main__":
    sys.exit(main())
