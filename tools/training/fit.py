#!/usr/bin/env python
"""Train the networks of arview, and fit its confidence, on random solids rendered in front of photos.

Needs torch and onnx. The steps in their order; later ones learn from what the detector finds with the earlier networks:

  fit.py edge-examples --solids 60 --photos DIR            pictures with edges, 60 for each seed
  fit.py edge-net --epochs 40                              edge_net.onnx
  fit.py denoiser --epochs 70                              denoiser.onnx, from the same pictures
  fit.py pose-examples --solids 100 --photos DIR           poses that the detector tries, labelled
  fit.py profile-ranker                                    profile_ranker.npz
  fit.py pose-verifier                                     pose_verifier.onnx
  fit.py contour-examples --from 900 --solids 150 --photos DIR     contour profiles at final hypotheses
  fit.py contour-verifier --epochs 14                      contour_verifier.onnx
  fit.py pair-examples --from 40000 --solids 180 --photos DIR      near-symmetric poses
  fit.py pair-comparator --epochs 8                        pair_comparator.onnx
  fit.py component-examples --solids 300 --photos DIR      components of random assemblies, right and wrong
  fit.py presence-net                                      presence_net.onnx
  fit.py confidence --from 500 --solids 40 --photos DIR    prints the weights for pose_confidence.json

  fit.py tracked-pose SCENE...                             quality of tracked poses, from sequences with truth

  fit.py backgrounds --solids 120 --photos DIR --things CUTOUTS    further backgrounds

Examples and networks are written to out/training. To use a network, copy it to src/arview/weights and update its entry
in manifest.json there.

DIR holds at least 20 photos of anything but the parts that will be searched: the networks learn that what a photo shows
is background. A few hundred photos are soon memorised; packages of Debian hold 2,000 more (labelme-examples, cimg-doc,
opencv-doc, redeclipse-data, supertuxkart-data, ufoai-textures, flightgear-data-base, stellarium-data; leave out their
normal maps). Do not use frames of the recorded sequences: the part in them would be learned as background. Few photos
show many small things side by side, as a workbench does: `backgrounds` scatters cut-out pictures of things (with
transparency, such as those of Debian's tuxpaint-stamps-default) on parts of photos, one picture for each seed.
Default: photos of Python packages, of Debian's mate-backgrounds, and those in $ARVIEW_BACKGROUNDS.

Each seed takes about 20 s and 10 MB for edge-examples, 40 s and 60 MB for pose-examples, 25 s and 15 MB for
contour-examples, 10 s and 20 MB for pair-examples, and 10 s and 6 MB for component-examples, for the third of the
solids that are assemblies. Several may run at once with other --from; existing files are kept. contour-examples needs
solids that the pose verifier was not trained on. With --continue training begins from the network in the package, which
may be narrower than the new one, except for the profile ranker. The same seeds give the same pictures; the poses that
the threaded search tries in them vary a little.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmarks"))  # photos and recordings are shared

from arview.errors import ArviewError, InputError
from component_odds_examples import collect_component_odds
from component_odds_fitting import fit_component_odds
from composite_backgrounds import make_composites
from confidence_fitting import fit_confidence
from contour_examples import collect_contours
from contour_fitting import fit_contour_verifier
from denoiser_fitting import fit_denoiser
from edge_net_examples import collect_edge_pictures
from edge_net_fitting import fit_edge_net
from options import positive, seed
from pair_examples import collect_pairs
from pair_fitting import fit_pair_comparator
from photos import fitting_photos
from pose_verifier_fitting import fit_pose_verifier
from presence_net_examples import collect_components
from presence_net_fitting import fit_presence_net
from profile_ranker_examples import collect_pose_examples
from profile_ranker_fitting import fit_profile_ranker
from tracked_pose_fitting import fit_tracked_pose

EXAMPLES: dict[str, Callable[[range, tuple[Path, ...], Path], None]] = {
    "edge-examples": collect_edge_pictures,
    "pose-examples": collect_pose_examples,
    "contour-examples": collect_contours,
    "pair-examples": collect_pairs,
    "component-examples": collect_components,
    "component-odds-examples": collect_component_odds,
}
"""Steps that make examples of random solids."""
NETWORKS: dict[str, Callable[[Path, int, bool], None]] = {
    "edge-net": fit_edge_net,
    "denoiser": fit_denoiser,
    "profile-ranker": fit_profile_ranker,
    "pose-verifier": fit_pose_verifier,
    "contour-verifier": fit_contour_verifier,
    "presence-net": fit_presence_net,
}
"""Steps that train a network from scratch, or continue its training."""


def main() -> int:
    chosen = parser().parse_args()
    try:
        chosen.run(chosen)
    except ArviewError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
    return 0


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    steps = made.add_subparsers(required=True, metavar="STEP")
    folder = argparse.ArgumentParser(add_help=False)
    folder.add_argument("--folder", type=Path, default=Path("out/training"), help="default: out/training")
    solids = argparse.ArgumentParser(add_help=False)
    solids.add_argument("--from", dest="first", type=seed, default=0, metavar="N", help="first seed; default: 0")
    solids.add_argument("--solids", type=positive, default=100, metavar="N", help="number of seeds; default: 100")
    solids.add_argument("--photos", type=Path, metavar="DIR", help="backgrounds; default: the machine's")
    epochs = argparse.ArgumentParser(add_help=False)
    epochs.add_argument("--epochs", type=positive, default=12, metavar="N", help="of the training; default: 12")
    for name, collect in EXAMPLES.items():
        step = steps.add_parser(name, parents=[solids, folder], help="make examples")
        step.set_defaults(run=run_examples, collect=collect)
    for name, fit in NETWORKS.items():
        step = steps.add_parser(name, parents=[epochs, folder], help="train this network")
        step.add_argument("--continue", dest="goes_on", action="store_true", help="from the network in the package")
        step.set_defaults(run=run_network, fit=fit)
    step = steps.add_parser("pair-comparator", parents=[epochs, folder], help="train this network")
    step.set_defaults(run=lambda chosen: fit_pair_comparator(chosen.folder, chosen.epochs))
    step = steps.add_parser("component-odds", parents=[folder], help="fit the weights of the log odds of components")
    step.set_defaults(run=lambda chosen: fit_component_odds(chosen.folder))
    step = steps.add_parser("confidence", parents=[solids], help="fit the weights of the confidence")
    step.set_defaults(run=lambda chosen: fit_confidence(seeds_of(chosen), fitting_photos(chosen.photos)))
    step = steps.add_parser("tracked-pose", parents=[folder], help="fit the quality of tracked poses")
    step.add_argument("scenes", type=Path, nargs="+", metavar="SCENE", help="folders as `arview evaluate` takes them")
    step.add_argument("--rotations", type=Path, nargs="+", default=[], metavar="SCENE", help="only rotations are exact")
    step.set_defaults(run=lambda chosen: fit_tracked_pose(chosen.scenes, chosen.rotations, chosen.folder))
    step = steps.add_parser("backgrounds", parents=[solids, folder], help="make backgrounds of things on photos")
    step.add_argument("--things", type=Path, metavar="CUTOUTS", help="folder of pictures with transparency")
    step.set_defaults(run=run_backgrounds)
    return made


def seeds_of(chosen: argparse.Namespace) -> range:
    return range(chosen.first, chosen.first + chosen.solids)


def run_examples(chosen: argparse.Namespace) -> None:
    chosen.collect(seeds_of(chosen), fitting_photos(chosen.photos), chosen.folder)


def run_network(chosen: argparse.Namespace) -> None:
    chosen.fit(chosen.folder, chosen.epochs, not chosen.goes_on)


def run_backgrounds(chosen: argparse.Namespace) -> None:
    if chosen.things is None:
        raise InputError("fit.py: backgrounds needs --things, a folder of pictures with transparency")
    make_composites(seeds_of(chosen), fitting_photos(chosen.photos), chosen.things, chosen.folder / "backgrounds")


if __name__ == "__main__":
    sys.exit(main())
